"""One background thread for a node's heavy work, so that the executor never waits."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any


class Worker:
    """Runs one job at a time, in order of arrival; a waiting job is replaced by a newer one with the same key.

    Parameters
    ----------
    wake
        Called from the worker thread after each job: it must make the executor call :meth:`deliver`.

    Notes
    -----
    Results are handed over in the executor's thread, so a node needs no lock. The thread is a daemon: a job that runs
    when the process is told to stop does not hold it up.
    """

    def __init__(self, wake: Callable[[], object]) -> None:
        self._wake = wake
        self._waiting: OrderedDict[str, tuple[Callable[[], Any], Callable[[Future[Any]], None]]] = OrderedDict()
        self._finished: list[tuple[Callable[[Future[Any]], None], Future[Any]]] = []
        self._condition = threading.Condition()
        self._stopped = False
        threading.Thread(target=self._run, name="worker", daemon=True).start()

    def submit(self, key: str, job: Callable[[], Any], done: Callable[[Future[Any]], None]) -> None:
        """Queue a job; `done` gets its finished future in the executor's thread."""
        with self._condition:
            self._waiting.pop(key, None)
            self._waiting[key] = (job, done)
            self._condition.notify()

    def deliver(self) -> None:
        """Hand finished jobs over; the executor calls this."""
        with self._condition:
            finished, self._finished = self._finished, []
        for done, future in finished:
            done(future)

    def stop(self) -> None:
        """Take no further job."""
        with self._condition:
            self._waiting.clear()
            self._stopped = True
            self._condition.notify()

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._waiting or self._stopped)
                if self._stopped:
                    return
                _, (job, done) = self._waiting.popitem(last=False)
            future: Future[Any] = Future()
            try:
                future.set_result(job())
            except BaseException as error:  # handed over: the node reports it
                future.set_exception(error)
            with self._condition:
                self._finished.append((done, future))
                if self._stopped:
                    return
            self._wake()

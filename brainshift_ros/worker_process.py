"""Long C++ work in a process of its own, which never outlives the one that started it.

Between the two stands a watcher: it holds the read end of a pipe whose write end only the starter has. When the starter
ends, however (SIGKILL too), the pipe closes; the watcher then kills the worker and removes its folder.
Only the standard library is imported here, so that the watcher starts at once and is small.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

_POLL_S = 0.1
_USAGE = "usage.json"
_LOG = "worker.log"


@dataclass(frozen=True)
class WorkerResult:
    """How a worker ended.

    Attributes
    ----------
    status
        Exit status, negative for a signal.
    last_line
        The last that it wrote, to either stream; for messages.
    cpu_s
        User and system time, seconds.
    peak_bytes
        Largest resident set size.
    """

    status: int
    last_line: str
    cpu_s: float
    peak_bytes: int


def run_worker(
    module: str,
    arguments: Sequence[str],
    folder: Path,
    *,
    timeout_s: float,
    environment: Mapping[str, str] | None = None,
    waiting: Callable[[float], None] | None = None,
) -> WorkerResult:
    """Run ``python -m module arguments`` in a folder and wait for it.

    Parameters
    ----------
    module
        Importable name.
    arguments
        Its command line.
    folder
        A temporary folder, the worker's working directory: it is removed if the caller dies.
    timeout_s
        Wall time after which the worker is killed.
    environment
        Variables to set beside the caller's.
    waiting
        Called a few times a second, in the calling thread, with the seconds waited so far.

    Raises
    ------
    TimeoutError
        It ran longer than `timeout_s`.
    """
    watcher = subprocess.Popen(
        [sys.executable, "-m", __name__, str(folder), module, *arguments],
        cwd=folder,
        env={**os.environ, **(environment or {})},
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        # A session of its own: Ctrl-C in a terminal reaches the caller alone, which then ends the worker.
        start_new_session=True,
    )
    assert watcher.stdin is not None
    start = time.monotonic()
    try:
        while watcher.poll() is None:
            if waiting is not None:
                waiting(time.monotonic() - start)
            if time.monotonic() - start > timeout_s:
                raise TimeoutError(f"{module} did not finish in {timeout_s:g} s")
            time.sleep(_POLL_S)
    finally:
        watcher.stdin.close()
        watcher.wait()
    usage = json.loads(Path(folder, _USAGE).read_text(encoding="utf-8"))
    return WorkerResult(**usage, last_line=_last_line(Path(folder, _LOG)))


def watch(folder: Path, module: str, arguments: Sequence[str]) -> None:
    """Run a worker until it ends, or until standard input closes; then kill it and remove the folder."""
    with open(folder / _LOG, "wb") as log:
        worker = subprocess.Popen(
            [sys.executable, "-m", module, *arguments], stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
    status = None
    while status is None:
        closed, _, _ = select.select([sys.stdin], [], [], _POLL_S)
        if closed:
            worker.kill()
            worker.wait()
            shutil.rmtree(folder, ignore_errors=True)
            return
        ended, wait_status, used = os.wait4(worker.pid, os.WNOHANG)
        if ended:
            status = os.waitstatus_to_exitcode(wait_status)
    unit = 1 if sys.platform == "darwin" else 1024
    usage = {"status": status, "cpu_s": used.ru_utime + used.ru_stime, "peak_bytes": used.ru_maxrss * unit}
    (folder / _USAGE).write_text(json.dumps(usage), encoding="utf-8")


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


if __name__ == "__main__":
    watch(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])

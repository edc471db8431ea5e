"""Solve the jobs of a build on the workers of a dask.distributed scheduler: the only module that imports it.

The patient and the settings travel to the workers once; the jobs name only entries. Neighbouring jobs are offered to the
same worker, since all jobs of a resection state share its assembled and factorised model, but an idle worker may take any.
A worker that dies loses nothing but time: the scheduler gives its jobs to the others. Nothing is pinned to a worker.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from time import monotonic
from uuid import uuid4

from distributed import Client, Future, KilledWorker, wait
from distributed.client import FutureCancelledError

from brainshift_ros import __version__
from brainshift_ros.atlas.jobs import Job, SolvedJob
from brainshift_ros.atlas.problem import Problem, Progress, StateModel
from brainshift_ros.errors import InputError

#: Seconds to wait for a scheduler's answer; for its first worker; and, once work has begun, for one when all are gone.
CONNECT_S, WORKERS_S, ABSENCE_S = 10.0, 10.0, 60.0
_POLL_S = 1.0

#: dask gives a worker's numerical libraries one thread, so a machine needs as many workers as it has cores to give.
_WORKER = "dask worker {} --nthreads 1 --nworkers CORES"
_SAME_VERSION = f"start the workers in an environment with this brainshift_ros: `{_WORKER.format('ADDRESS')}`"


def solve_on_cluster(
    address: str, problem: Problem, jobs: Sequence[Job], progress: Progress
) -> Iterator[tuple[Job, SolvedJob]]:
    """Solve jobs on a scheduler's workers; they come as they are done, in any order.

    Parameters
    ----------
    address
        Of the scheduler, as ``tcp://host:8786``.
    problem
        What the jobs share.
    jobs
        Those of one resection state side by side.
    progress
        Called with a stage and the fraction of all the jobs that is done.

    Raises
    ------
    InputError
        The scheduler cannot be reached or is lost, has no workers, or workers of another software version; or the patient's
        mesh cannot be solved.
    ArithmeticError
        A residual is too large.
    """
    with _connected(address) as client:
        build = uuid4().hex
        workers = _workers_of(client, address)
        shared = _share(client, problem, build)
        pending: dict[Future, Job] = {}
        for number, job in enumerate(jobs):
            preferred = workers[number * len(workers) // len(jobs)]
            future = client.submit(
                solve_job,
                *(shared, build, job, __version__),
                key=f"atlas-{build}-{job.number}",
                workers=[preferred],
                allow_other_workers=True,
                priority=-job.number,
            )
            pending[future] = job
        try:
            yield from _as_they_come(client, address, pending, progress)
        finally:
            client.cancel(list(pending))
            client.run(_forget, build, on_error="ignore")


def _as_they_come(
    client: Client, address: str, pending: dict[Future, Job], progress: Progress
) -> Iterator[tuple[Job, SolvedJob]]:
    total, done = sum(len(job.entries) for job in pending.values()), 0
    seen = monotonic()
    while pending:
        count = len(client.nthreads())
        progress(f"solve on {count} worker{'' if count == 1 else 's'}", done / total)
        seen = monotonic() if count else seen
        if monotonic() - seen > ABSENCE_S:
            raise InputError(address, "all its workers are gone", "start some, and run the same command: it resumes")
        try:
            with client.as_current():
                finished = wait(list(pending), timeout=_POLL_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            continue
        for future in finished:
            job = pending[future]
            try:
                solved = future.result()
            except KilledWorker as error:
                remedy = "give them more memory, or start fewer on a machine; the same command resumes"
                raise InputError(address, f"its workers died of a job, one after the other ({error})", remedy) from error
            del pending[future]
            done += len(job.entries)
            yield job, solved


def _client(address: str) -> Client:
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False, name="brainshift-atlas")
    except AssertionError:
        # dask waits ten seconds for its event loop's thread, and was once seen to wait in vain: a second one starts.
        return Client(address, timeout=CONNECT_S, set_as_default=False, name="brainshift-atlas")


@contextmanager
def _connected(address: str) -> Iterator[Client]:
    try:
        client = _client(address)
    except (OSError, ValueError) as error:
        remedy = "start it with `dask scheduler`, and give the address that it prints"
        raise InputError(address, f"no dask scheduler answers there ({error})", remedy) from error
    try:
        yield client
    except (OSError, CancelledError, FutureCancelledError) as error:
        remedy = "start it again with its workers, and run the same command: it resumes"
        raise InputError(address, f"the scheduler was lost ({error})", remedy) from error
    finally:
        client.close(timeout=CONNECT_S)


def _workers_of(client: Client, address: str) -> list[str]:
    """Addresses of the workers, all of this software's version."""
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError as error:
        raise InputError(address, "the scheduler has no workers", f"start some: `{_WORKER.format(address)}`") from error
    for worker, version in client.run(_software, on_error="return").items():
        if isinstance(version, Exception):
            raise InputError(worker, f"the worker cannot run this software ({version})", _SAME_VERSION) from version
        _check_version(version, worker)
    return list(client.nthreads())


def _share(client: Client, problem: Problem, build: str) -> Future:
    """Bring the problem to the workers. As the result of a task it is made again if the worker that holds it dies."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sending large graph")
        return client.submit(_same, problem, key=f"atlas-{build}-problem")


def _same(problem: Problem) -> Problem:
    return problem


# --- on the worker ---------------------------------------------------------------------------------------------------

_lock = threading.Lock()
_models: dict[tuple[str, bool], StateModel] = {}


def solve_job(problem: Problem, build: str, job: Job, version: str) -> SolvedJob:
    """Solve a job on a worker, with the resection state's model if the worker has made it already.

    One job at a time, whatever the worker's number of threads, and one model, which takes most of the memory.
    """
    _check_version(version, "client")
    with _lock:
        key = (build, job.resected)
        if key not in _models:
            _models.clear()
            _models[key] = StateModel(problem, job.resected, _silent)
        return _models[key].solve(job, _silent)


def _forget(build: str) -> None:
    for key in [key for key in _models if key[0] == build]:
        del _models[key]


def _software() -> str:
    return __version__


def _check_version(version: str, source: str) -> None:
    if version != __version__:
        raise InputError(source, f"runs brainshift_ros {version}, here it is {__version__}", _SAME_VERSION)


def _silent(stage: str, fraction: float) -> None:
    pass

"""Registration of two images by greedy (Yushkevich et al. 2016), in a process of its own.

greedy is C++ that may crash or take very long on odd input; a process can be watched and ended, and gives one clear error.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from brainshift_ros.errors import InputError
from brainshift_ros.worker_process import WorkerResult, run_worker


def run_greedy(
    folder: Path, command: str, stage: str, timeout_s: float, waiting: Callable[[float], None] | None = None
) -> WorkerResult:
    """Run one greedy command in a folder that holds its images and receives its results.

    Parameters
    ----------
    folder
        Temporary; file names in `command` are relative to it.
    command
        Options as on greedy's command line.
    stage
        What an error calls this step.
    timeout_s
        Wall time after which greedy is ended.
    waiting
        Called a few times a second with the seconds waited so far.

    Raises
    ------
    InputError
        greedy refused, crashed, or took longer than `timeout_s`.
    """
    worker_module = "brainshift_ros.segmentation.greedy_worker"
    try:
        worker = run_worker(worker_module, [command], folder, timeout_s=timeout_s, waiting=waiting)
    except TimeoutError as error:
        problem = f"the {stage} registration did not finish in {timeout_s:g} s"
        raise InputError("segmentation", problem, "ask for a coarser resolution, or give --labels") from error
    if worker.status != 0:
        problem = f"the {stage} registration ended with status {worker.status} {worker.last_line}".rstrip()
        raise InputError("segmentation", problem, "see that the T1 shows a head; else give --labels")
    return worker

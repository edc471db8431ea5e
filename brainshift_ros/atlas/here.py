"""Solve the jobs of a build in this process, one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from brainshift_ros.atlas.jobs import Job, SolvedJob
from brainshift_ros.atlas.problem import Problem, Progress, StateModel

#: Assembly and factorisation of a resection state take about as long as solving this many entries; for progress only.
PREPARATION_ENTRIES = 150


def solve_here(problem: Problem, jobs: Sequence[Job], progress: Progress) -> Iterator[tuple[Job, SolvedJob]]:
    """Solve jobs, in the order in which they are given.

    Parameters
    ----------
    problem
        What the jobs share.
    jobs
        Those of one resection state side by side: each state's model is made once, and freed before the next is made.
    progress
        Called with a stage and the fraction of all the jobs that is done.

    Raises
    ------
    InputError
        The patient's mesh cannot be solved.
    ArithmeticError
        A residual is too large.
    """
    states = len({job.resected for job in jobs})
    total = sum(len(job.entries) for job in jobs) + states * PREPARATION_ENTRIES
    done, weight = 0, 0

    def report(stage: str, fraction: float) -> None:
        progress(stage, (done + fraction * weight) / total)

    model: StateModel | None = None
    resected: bool | None = None
    for job in jobs:
        if job.resected != resected:
            model = None  # gives its memory back before the next one needs it
            weight = PREPARATION_ENTRIES
            model, resected = StateModel(problem, job.resected, report), job.resected
            done += weight
        assert model is not None
        weight = len(job.entries)
        solved = model.solve(job, report)
        done += weight
        weight = 0
        yield job, solved

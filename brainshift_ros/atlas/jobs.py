"""The parts that a build is done in: some orientations of one resection state, with all mechanisms and levels of these."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import AtlasEntry

#: Entries of one job, about: enough that blocks of right-hand sides stay full, few enough that little is lost with a job.
JOB_ENTRIES = 64


@dataclass(frozen=True)
class Job:
    """Neighbouring columns of the atlas that are solved together.

    Attributes
    ----------
    number
        Its place among the jobs of the build.
    first
        The first of its columns.
    entries
        Parameters of its columns, all of one resection state.
    """

    number: int
    first: int
    entries: tuple[AtlasEntry, ...]

    @property
    def resected(self) -> bool:
        """Whether the tumour's elements are removed."""
        return self.entries[0].resected

    @property
    def stop(self) -> int:
        """The column after its last."""
        return self.first + len(self.entries)


@dataclass(frozen=True)
class SolvedJob:
    """What a job gives.

    Attributes
    ----------
    columns
        Shape (N, 3, k), m.
    diagnostics
        Shape (k,), of :data:`~brainshift_ros.atlas.diagnostics.DIAGNOSTICS`.
    solver
        Name of the linear solver that was used.
    variable_normals
        Number of skull normals that some entries of the resection state hold and others free.
    warnings
        About the elements that were solved.
    times_s
        Wall time by stage; assembly and factorisation count for the first job of a resection state alone.
    """

    columns: NDArray[np.float32]
    diagnostics: NDArray
    solver: str
    variable_normals: int
    warnings: tuple[str, ...]
    times_s: Mapping[str, float]


def jobs_of(entries: Sequence[AtlasEntry], size: int = JOB_ENTRIES) -> tuple[Job, ...]:
    """Cut the entries of an atlas into jobs of at most `size` entries, or of one orientation where that has more.

    Orientations are never divided: the entries of one share the factorisation of their boundary conditions.
    """
    jobs: list[Job] = []
    first = 0
    for _, of_state in groupby(entries, key=lambda entry: entry.resected):
        orientations = [tuple(group) for _, group in groupby(of_state, key=lambda entry: entry.gravity_direction)]
        largest = max(len(group) for group in orientations)
        count = -(-len(orientations) // max(1, size // largest))
        for part in _even_parts(orientations, count):
            members = tuple(entry for group in part for entry in group)
            jobs.append(Job(len(jobs), first, members))
            first += len(members)
    return tuple(jobs)


def _even_parts(groups: Sequence[tuple[AtlasEntry, ...]], count: int) -> Iterator[Sequence[tuple[AtlasEntry, ...]]]:
    edges = np.linspace(0, len(groups), count + 1).round().astype(int)
    for start, stop in pairwise(edges):
        yield groups[start:stop]

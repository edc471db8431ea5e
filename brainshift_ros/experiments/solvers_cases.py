"""Weight problems of the study :mod:`brainshift_ros.experiments.solvers`: real atlases, real noise, and columns made hard."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.inverse_cases import measure, study_atlas, study_scene, subset
from brainshift_ros.experiments.inverse_truths import drawn_truth, solved_truths, truth_patients
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.atlas_like import AtlasLike
from brainshift_ros.inverse.problem import WeightProblem
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.inverse.weighting import weighted_problem
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]
Matrix = NDArray[np.float64]

#: Measured points, and their noise: the upper end of the thesis's 15 to 24.
POINTS, NOISE_M = 24, float(mm_to_m(0.5))

#: Points of a dense field: 5,000 and 15,000 rows.
DENSE, DENSER = 1_667, 5_000

_ATLAS_NODES, _TRUTH_NODES = 3_000, 3_500

#: Head orientations of the widest atlas, of 12 columns each.
_WIDE_SHORT, _WIDE_FULL = 240, 834

#: What is done to the columns of the 720-column problem, A of shape (r, m).
HARD: dict[str, Callable[[Matrix, np.random.Generator], Matrix]] = {
    "every column twice": lambda A, rng: np.concatenate([A, A], axis=1),
    "twice, 1e-8 apart": lambda A, rng: np.concatenate([A, A * (1.0 + 1e-8 * rng.normal(size=A.shape))], axis=1),
    "twice, 1e-12 apart": lambda A, rng: np.concatenate([A, A * (1.0 + 1e-12 * rng.normal(size=A.shape))], axis=1),
    "multiples": lambda A, rng: np.concatenate([A, 2.0 * A, 0.5 * A], axis=1),
    "and their opposites": lambda A, rng: np.concatenate([A, -A], axis=1),
    "sizes from 1e-6 to 1": lambda A, rng: A * 10.0 ** rng.uniform(-6.0, 0.0, A.shape[1]),
    "rank 3": lambda A, rng: _of_rank(A, 3),
    "one point": lambda A, rng: A[:3],
}


@dataclass(frozen=True)
class SolverCase:
    """A problem, and where it belongs.

    Attributes
    ----------
    family
        Problems of one kind, drawn together.
    name
        Within the family.
    truth
        Seed of the truth whose shift was measured.
    problem
        Rows in units of their standard deviation.
    """

    family: str
    name: str
    truth: int
    problem: WeightProblem


def cases(folder: Path, full: bool, seeds: range, progress: Progress) -> Iterator[SolverCase]:
    """Make the problems, one truth after another.

    Parameters
    ----------
    folder
        Keeps meshes, atlases and truths.
    full
        Adds 15,000 rows, and widens the widest atlas to 10,008 columns.
    seeds
        One truth each, on another mesh than the atlas's.
    progress
        Called with stage and fraction done.
    """
    atlas = study_atlas(folder, study_scene(), progress, nodes=_ATLAS_NODES)
    orientations = _WIDE_FULL if full else _WIDE_SHORT
    wide = study_atlas(folder, study_scene(orientations=orientations), progress, nodes=_ATLAS_NODES)
    locator = PointLocator(atlas.mesh)
    few = subset(atlas, np.arange(0, len(atlas.entries), len(atlas.entries) // 60))
    patients = truth_patients(folder, _TRUTH_NODES, progress)
    specs = [drawn_truth(seed) for seed in seeds]
    for seed, truth in zip(seeds, solved_truths(folder, patients, specs, progress), strict=True):
        rng = np.random.default_rng([seed, 7])
        sparse = measure(truth, POINTS, NOISE_M, rng)
        for source in (few, atlas, wide):
            problem = _problem(source, sparse, locator)
            columns = f"{problem.A.shape[1]:,} columns"
            yield SolverCase(f"{POINTS} points, {columns}", columns, seed, problem)
            if source is atlas:
                yield from _hard(problem, seed, rng)
        for count in (DENSE, DENSER) if full else (DENSE,):
            problem = _problem(atlas, measure(truth, count, NOISE_M, rng), locator)
            yield SolverCase(f"{3 * count:,} rows, 720 columns", f"{3 * count:,} rows", seed, problem)


def _problem(atlas: AtlasLike, measured: HomologousPoints, locator: PointLocator) -> WeightProblem:
    whole = AppendedAtlas(atlas, None)
    rows = rows_at_points(whole, measured, locator=locator)
    return weighted_problem(rows.M, measured.displacements[rows.kept], measured.sigma[rows.kept], whole.groups)


def _hard(problem: WeightProblem, seed: int, rng: np.random.Generator) -> Iterator[SolverCase]:
    """Make the columns of a measurement hard to tell apart, and its shift larger than any."""
    family = f"{POINTS} points, degenerate"
    for name, change in HARD.items():
        A = change(problem.A, rng)
        groups = (WeightGroup("all", tuple(range(A.shape[1]))),)
        yield SolverCase(family, name, seed, WeightProblem(A, problem.b[: len(A)], groups))
    yield SolverCase(family, "five times the shift", seed, replace(problem, b=5.0 * problem.b))


def _of_rank(A: Matrix, rank: int) -> Matrix:
    U, s, Vt = np.linalg.svd(A, full_matrices=False)
    return np.asarray((U[:, :rank] * s[:rank]) @ Vt[:rank])

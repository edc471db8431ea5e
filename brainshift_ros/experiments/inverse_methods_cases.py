"""Part of :mod:`brainshift_ros.experiments.inverse_methods`: every method on every truth, the same points for all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.inverse_cases import Targets, mean_of_points, measure
from brainshift_ros.experiments.inverse_truths import InverseTruth
from brainshift_ros.experiments.skull_cases import MemoryAtlas
from brainshift_ros.geometry import unit
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.methods import solve_weights
from brainshift_ros.inverse.problem import WeightProblem, WeightSolution
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.inverse.span import atlas_span
from brainshift_ros.inverse.unconstrained import solve_tikhonov
from brainshift_ros.inverse.weighting import weighted_problem
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.units import m_to_mm, mm_to_m

Row = dict[str, Any]

#: Names of the estimators, in the order of tables and charts.
LEAST_SQUARES, CONSTRAINED, NO_LIMIT = "least squares (3.5)", "constrained (3.9)", "constrained, sum not limited"
SHIPPED, MEAN, NOTHING = "constrained, outliers looked for", "mean of the points", "no correction"
BEST_CONSTRAINED, BEST_FREE = "whole field known, constrained", "whole field known, free"

#: lambda of (3.8): all that are tried, and those that the tables compare.
SWEPT = tuple(10.0**power for power in range(-10, 1))
LAMBDAS = (1e-8, 1e-6, 1e-4, 1e-2)


def tikhonov_name(lambda_: float) -> str:
    """Name of Tikhonov's method with a given lambda."""
    return f"Tikhonov, λ = {lambda_:.0e}"


#: Methods under test: each finds weights from the same weighted rows.
METHODS: Mapping[str, Callable[[WeightProblem], WeightSolution]] = {
    LEAST_SQUARES: partial(solve_weights, method="least_squares"),
    **{tikhonov_name(value): partial(solve_tikhonov, lambda_=value) for value in LAMBDAS},
    "Tikhonov, GCV": partial(solve_weights, method="tikhonov_gcv"),
    "Tikhonov, L-curve": partial(solve_weights, method="tikhonov_l_curve"),
    NO_LIMIT: lambda problem: solve_weights(replace(problem, groups=())),
    CONSTRAINED: partial(solve_weights, method="constrained"),
}

_SWEEP: Mapping[str, Callable[[WeightProblem], WeightSolution]] = {
    tikhonov_name(value): partial(solve_tikhonov, lambda_=value) for value in SWEPT if tikhonov_name(value) not in METHODS
}

#: Standard deviations of the noise, mm, and numbers of points, as the thesis's patients had.
NOISES_MM, POINTS = (0.5, 1.0), (15, 24)

#: Distances to the nearest measured point, mm, that the targets are sorted by.
DISTANCES_MM = np.arange(0.0, 121.0, 10.0)

#: Nodes of the truth that the ceilings are fitted to.
_CEILING_NODES = 1000

#: lambda of the unconstrained ceiling: without noise it only keeps 720 weights from fitting the nodes one by one.
_CEILING_LAMBDA = 1e-7


class Comparison:
    """All estimates of one atlas.

    Parameters
    ----------
    atlas
        The atlas.
    """

    def __init__(self, atlas: MemoryAtlas) -> None:
        self._atlas, self._locator, self._span = atlas, PointLocator(atlas.mesh), atlas_span(atlas)
        self._matrix = atlas.E.reshape(-1, atlas.E.shape[2])

    def rows(self, truth: InverseTruth, offset_mm: float = 0.0) -> tuple[list[Row], list[Row]]:
        """Errors of all estimates of one truth, by group, and by distance to the nearest measured point.

        Parameters
        ----------
        truth
            What happened.
        offset_mm
            Error that all points share, in a random direction, as of the tracker between two scans.
        """
        targets = Targets(truth, self._atlas, self._locator)
        by_group: list[Row] = []
        by_distance: list[Row] = []
        for number, noise_mm in enumerate(NOISES_MM):
            rng = np.random.default_rng([truth.spec.seed, number])
            measured = measure(truth, int(rng.integers(POINTS[0], POINTS[1] + 1)), float(mm_to_m(noise_mm)), rng)
            shared = mm_to_m(offset_mm) * unit(rng.normal(size=3))
            measured = replace(measured, displacements=measured.displacements + shared)
            labels = {"truth": truth.spec.seed, "noise_mm": noise_mm, "points": len(measured.points)}
            bins = _bins(truth, targets, measured)
            for method, field, told in self._estimates(measured):
                by_group += [labels | {"method": method} | row | told for row in targets.errors(field)]
                by_distance += [labels | {"method": method} | row for row in _by_distance(truth, targets, field, bins)]
        labels = {"truth": truth.spec.seed, "noise_mm": 0.0, "points": 0}
        for method, field, told in self._ceilings(truth, targets):
            by_group += [labels | {"method": method} | row | told for row in targets.errors(field)]
        return by_group, by_distance

    def _estimates(self, measured: HomologousPoints) -> Iterator[tuple[str, NDArray[np.float64], Row]]:
        """Displacement (N, 3), m, of every method, and what is told of its weights."""
        nodes = len(self._atlas.mesh.nodes)
        yield NOTHING, np.zeros((nodes, 3)), _told()
        yield MEAN, mean_of_points(self._atlas, measured), _told()
        rows = rows_at_points(AppendedAtlas(self._atlas, None), measured, locator=self._locator)
        M, u = rows.M, measured.displacements[rows.kept]
        problem = weighted_problem(M, u, measured.sigma[rows.kept], self._atlas.groups)
        found: dict[str, NDArray[np.float64]] = {}
        told: dict[str, Row] = {}
        for name, method in {**METHODS, **_SWEEP}.items():
            start = process_time()
            found[name] = method(problem).weights
            told[name] = _told(found[name], M @ found[name] - u, process_time() - start)
        for name, field in self._fields(found):
            yield name, field, told[name]
        estimate = estimate_shift(self._atlas, measured, locator=self._locator, span=self._span)
        residual = (estimate.estimated - estimate.measured)[estimate.used]
        yield SHIPPED, estimate.field.displacement, _told(estimate.solution.weights, residual)

    def _ceilings(self, truth: InverseTruth, targets: Targets) -> Iterator[tuple[str, NDArray[np.float64], Row]]:
        """Fit the truth's whole field, without noise: what the atlas's columns can express of it, in the mean square."""
        known = np.unique(np.concatenate(list(targets.groups.values())))
        chosen = np.random.default_rng(truth.spec.seed).choice(known, min(_CEILING_NODES, len(known)), replace=False)
        points = HomologousPoints(truth.mesh.nodes[chosen], truth.displacement[chosen], np.ones(len(chosen)))
        rows = rows_at_points(AppendedAtlas(self._atlas, None), points, locator=self._locator)
        A, b = rows.M.reshape(-1, rows.M.shape[2]), points.displacements[rows.kept].reshape(-1)
        gram = A.T @ A
        found = {
            BEST_CONSTRAINED: solve_weights(WeightProblem(A, b, self._atlas.groups), "constrained").weights,
            BEST_FREE: np.linalg.solve(gram + _CEILING_LAMBDA * np.trace(gram) * np.eye(len(gram)), A.T @ b),
        }
        for name, field in self._fields(found):
            yield name, field, _told(found[name], (A @ found[name] - b).reshape(-1, 3))

    def _fields(self, weights: Mapping[str, NDArray[np.float64]]) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """Displacements (N, 3), m, of several weights at once, since the matrix is read from memory once for all of them."""
        fields = self._matrix @ np.stack(list(weights.values()), axis=1).astype(np.float32)
        for name, field in zip(weights, fields.T, strict=True):
            yield name, field.astype(np.float64).reshape(-1, 3)


def _told(weights: NDArray[np.float64] | None = None, residual: NDArray[np.float64] | None = None, cpu_s: float = 0.0) -> Row:
    """Say how an estimate came about: mean residual at its points, and the size of its weights."""
    if weights is None or residual is None:
        weights, residual = np.zeros(1), np.full((1, 3), np.nan)
    return {
        "residual_mm": float(m_to_mm(np.linalg.norm(residual, axis=1).mean())),
        "nonzero": int(np.count_nonzero(weights)),
        "negative": int((weights < 0.0).sum()),
        "sum_of_sizes": float(np.abs(weights).sum()),
        "cpu_s": cpu_s,
    }


def _bins(truth: InverseTruth, targets: Targets, measured: HomologousPoints) -> list[NDArray[np.intp]]:
    """Targets of any group by their distance to the nearest measured point, one bin for each of the distances but the last."""
    ids = np.unique(np.concatenate(list(targets.groups.values())))
    distance, _ = cKDTree(measured.points).query(truth.mesh.nodes[ids])
    place = np.digitize(m_to_mm(distance), DISTANCES_MM) - 1
    return [ids[place == number] for number in range(len(DISTANCES_MM) - 1)]


def _by_distance(
    truth: InverseTruth, targets: Targets, field: NDArray[np.float64], bins: list[NDArray[np.intp]]
) -> Iterator[Row]:
    error = m_to_mm(np.linalg.norm(targets.difference(field), axis=1))
    shift = m_to_mm(np.linalg.norm(truth.displacement, axis=1))
    for start, ids in zip(DISTANCES_MM, bins, strict=False):
        if len(ids):
            yield {
                "distance_mm": float(start),
                "targets": len(ids),
                "shift_mm": float(shift[ids].mean()),
                "error_mm": float(error[ids].mean()),
            }

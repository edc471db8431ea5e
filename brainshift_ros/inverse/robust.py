"""Fit the weights although some points are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.inverse.methods import solve_weights
from brainshift_ros.inverse.problem import WeightProblem, WeightSolution

#: Median length of a standard normal 3-vector (chi distribution, three degrees of freedom).
_MEDIAN_CHI_3 = 1.5382

_MAX_ROUNDS = 10


@dataclass(frozen=True)
class RobustFit:
    """Weights fitted to the points that agree with each other.

    Attributes
    ----------
    solution
        Of the problem below.
    problem
        The weighted problem (8.3) of the points in use.
    used
        Shape (n,), False for outliers.
    """

    solution: WeightSolution
    problem: WeightProblem
    used: NDArray[np.bool_]


def fit_robustly(
    M: NDArray[np.float64],
    displacements: NDArray[np.float64],
    sigma: NDArray[np.float64],
    groups: Sequence[WeightGroup],
    *,
    method: str = "constrained",
    outlier_sigmas: float = 4.5,
) -> RobustFit:
    """Fit by weighted least squares, without points whose residual is far beyond what the others show.

    The scale of the residuals is their median, never taken below the stated sigma. Only if the first fit leaves outliers
    does the fit start again with weights that fall with the residual (iteratively reweighted towards least absolute
    deviations, which a minority of wrong points cannot drag along); then outliers are dropped and re-admitted until the
    set stands. At least half of the points always stay in use.

    Parameters
    ----------
    M
        Shape (n, 3, m), the atlas at the points.
    displacements
        Shape (n, 3), metres.
    sigma
        Shape (n,), standard deviation of a displacement component, metres.
    groups, method
        As for :class:`WeightProblem` and :func:`solve_weights`.
    outlier_sigmas
        Threshold in robust standard deviations of a component.
    """

    def fit(points: NDArray, sigmas: NDArray) -> tuple[WeightSolution, WeightProblem]:
        per_row = np.repeat(1.0 / sigmas[points], 3)
        A = M[points].reshape(3 * len(points), -1) * per_row[:, None]
        problem = WeightProblem(A, displacements[points].reshape(-1) * per_row, tuple(groups))
        return solve_weights(problem, method), problem

    def misfit(solution: WeightSolution) -> NDArray[np.float64]:
        return np.linalg.norm(M @ solution.weights - displacements, axis=1) / sigma

    everything = np.arange(len(sigma))
    solution, problem = fit(everything, sigma)
    used = _inliers(misfit(solution), outlier_sigmas)
    if used.all():
        return RobustFit(solution, problem, used)
    for _ in range(_MAX_ROUNDS):
        length = misfit(solution)
        scale = _scale(length)
        solution, _unused = fit(everything, sigma * np.sqrt(np.maximum(length / scale, 1.0)))
        if np.allclose(misfit(solution), length, rtol=0.05, atol=0.05 * scale):
            break
    for _ in range(_MAX_ROUNDS):
        now = _inliers(misfit(solution), outlier_sigmas)
        solution, problem = fit(np.flatnonzero(now), sigma)
        settled = bool((now == used).all())
        used = now
        if settled:
            break
    return RobustFit(solution, problem, used)


def _scale(length: NDArray) -> float:
    return max(1.0, float(np.median(length)) / _MEDIAN_CHI_3)


def _inliers(length: NDArray, outlier_sigmas: float) -> NDArray[np.bool_]:
    return length <= max(outlier_sigmas * _scale(length), float(np.median(length)))

"""Fit the weights although some points are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.inverse.methods import solve_weights
from brainshift_ros.inverse.problem import WeightProblem, WeightSolution
from brainshift_ros.inverse.trimmed import agreeing_half
from brainshift_ros.inverse.weighting import weighted_problem

#: Median length of a standard normal 3-vector (chi distribution, three degrees of freedom).
_MEDIAN_CHI_3 = 1.5382

#: Probability that noise alone makes any point suspicious.
_FALSE_ALARM = 0.05

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
    points: NDArray[np.float64],
    M: NDArray[np.float64],
    displacements: NDArray[np.float64],
    noise: NDArray[np.float64],
    groups: Sequence[WeightGroup],
    *,
    method: str = "constrained",
    outlier_sigmas: float = 4.5,
) -> RobustFit:
    """Fit by weighted least squares, without points whose residual is far beyond what the others show.

    If the plain fit leaves a suspicious residual, the fit starts again from the half of the points that agree best
    (:mod:`.trimmed`); then points are admitted and dropped by their residuals until the set stands. Their scale is the median,
    never taken below the stated sigma. At least half of the points always stay in use.

    Parameters
    ----------
    points, displacements
        Shape (n, 3), metres.
    M
        Shape (n, 3, m), the atlas at the points.
    noise
        Shape (n,), standard deviation of a displacement component, metres; or (n, n), its covariance over the points.
    groups, method
        As for :class:`WeightProblem` and :func:`solve_weights`.
    outlier_sigmas
        Threshold in robust standard deviations of a component.
    """
    sigma = noise if noise.ndim == 1 else np.sqrt(np.diagonal(noise))

    def fit(used: NDArray[np.bool_]) -> tuple[WeightSolution, WeightProblem]:
        chosen = noise[used] if noise.ndim == 1 else noise[np.ix_(used, used)]
        problem = weighted_problem(M[used], displacements[used], chosen, groups)
        return solve_weights(problem, method), problem

    def misfit(solution: WeightSolution) -> NDArray[np.float64]:
        return np.asarray(np.linalg.norm(M @ solution.weights - displacements, axis=1) / sigma)

    used = np.ones(len(points), dtype=bool)
    solution, problem = fit(used)
    if misfit(solution).max() <= chi.isf(_FALSE_ALARM / len(points), df=3):
        return RobustFit(solution, problem, used)
    used = agreeing_half(points, M, displacements, sigma, groups)
    for _ in range(_MAX_ROUNDS):
        solution, problem = fit(used)
        now = _inliers(misfit(solution), outlier_sigmas)
        if (now == used).all():
            break
        used = now
    else:
        solution, problem = fit(used)  # two sets that lead to each other: the last one is as good
    return RobustFit(solution, problem, used)


def _inliers(length: NDArray[np.float64], outlier_sigmas: float) -> NDArray[np.bool_]:
    median = float(np.quantile(length, 0.5, method="lower"))  # of two halves that contradict each other, the better one's
    return length <= max(outlier_sigmas * max(1.0, median / _MEDIAN_CHI_3), median)

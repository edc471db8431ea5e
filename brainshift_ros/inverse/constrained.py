"""The constrained weights (3.9), (6.3), exactly: the default of the inverse model."""

from __future__ import annotations

import numpy as np

from brainshift_ros.inverse.active_set import ActiveSet
from brainshift_ros.inverse.condensing import condensed
from brainshift_ros.inverse.problem import WeightProblem, WeightSolution, kkt_residual, saturated_groups
from brainshift_ros.solvers.threads import one_blas_thread


def solve_constrained(problem: WeightProblem) -> WeightSolution:
    """Solve the constrained problem exactly, by :class:`~brainshift_ros.inverse.active_set.ActiveSet`.

    Parameters
    ----------
    problem
        Any size and rank. Many more rows than columns are first condensed; the answer of the condensed rows then starts the
        iteration over the original ones, which ends after a few steps and is as exact as if nothing had been condensed.

    Returns
    -------
    Weights that are exactly zero outside the working set.
    """
    iterations, start = 0, None
    with one_blas_thread():
        small = condensed(problem)
        if small is not None:
            first = ActiveSet(small)
            first.run()
            iterations, start = first.iterations, first.weights
        active_set = ActiveSet(problem, start)
        converged = active_set.run()
    weights = active_set.weights
    return WeightSolution(
        weights=weights,
        method="constrained",
        residual_norm=float(np.linalg.norm(problem.A @ weights - problem.b)),
        kkt_residual=kkt_residual(problem, weights),
        iterations=iterations + active_set.iterations,
        converged=converged,
        saturated=saturated_groups(weights, problem.groups),
    )

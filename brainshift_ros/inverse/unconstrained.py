"""Least squares (3.5) and Tikhonov regularisation (3.7), (3.8): no bounds on the weights, no sum limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.inverse.problem import WeightProblem, WeightSolution, saturated_groups

#: lambda of (3.8) when none is given and no automatic choice is asked for.
DEFAULT_LAMBDA = 1e-3


def solve_least_squares(problem: WeightProblem) -> WeightSolution:
    """Minimum-norm least squares: (3.5) with the pseudo-inverse, since M^T M is singular with more columns than rows."""
    return _solution(problem, np.linalg.lstsq(problem.A, problem.b, rcond=None)[0], "least_squares", 0.0)


def solve_tikhonov(problem: WeightProblem, lambda_: float = DEFAULT_LAMBDA) -> WeightSolution:
    """Tikhonov regularisation (3.7) with ``beta^2 = lambda tr(A^T A)`` (3.8).

    Parameters
    ----------
    problem
        Groups are ignored.
    lambda_
        The positive weighting factor of (3.8).
    """
    if not lambda_ > 0.0:
        raise ValueError(f"lambda must be positive, not {lambda_}")
    U, s, Vt = np.linalg.svd(problem.A, full_matrices=False)
    factor = lambda_ * float(np.sum(s**2))
    return _filtered(problem, U, s, Vt, factor, "tikhonov")


def solve_tikhonov_gcv(problem: WeightProblem) -> WeightSolution:
    """Tikhonov regularisation with the factor that minimises generalised cross-validation (Golub, Heath, Wahba 1979)."""
    U, s, Vt = np.linalg.svd(problem.A, full_matrices=False)
    coefficients = U.T @ problem.b
    outside = max(float(problem.b @ problem.b - coefficients @ coefficients), 0.0)
    largest = max(float(s.max(initial=0.0)), np.finfo(float).tiny)
    factors = largest**2 * np.logspace(-12, 2, 141)
    damping = factors[:, None] / (s[None, :] ** 2 + factors[:, None])
    residual = np.sum((damping * coefficients) ** 2, axis=1) + outside
    freedom = damping.sum(axis=1) + (problem.b.size - s.size)
    best = int(np.argmin(residual / freedom**2))
    return _filtered(problem, U, s, Vt, float(factors[best]), "tikhonov_gcv")


def _filtered(problem: WeightProblem, U: NDArray, s: NDArray, Vt: NDArray, factor: float, method: str) -> WeightSolution:
    weights = Vt.T @ (s / (s**2 + max(factor, np.finfo(float).tiny)) * (U.T @ problem.b))
    return _solution(problem, weights, method, factor)


def _solution(problem: WeightProblem, weights: NDArray, method: str, factor: float) -> WeightSolution:
    """Optimality here is a vanishing gradient of ``||A a - b||^2 + factor ||a||^2``, scaled as in `kkt_residual`."""
    residual = problem.b - problem.A @ weights
    scale = max(
        float(np.linalg.norm(problem.A, axis=0).max(initial=0.0) * np.linalg.norm(problem.b)), float(np.finfo(float).tiny)
    )
    gradient = problem.A.T @ residual - factor * weights
    return WeightSolution(
        weights=weights,
        method=method,
        residual_norm=float(np.linalg.norm(residual)),
        kkt_residual=float(np.abs(gradient).max(initial=0.0)) / scale,
        iterations=0,
        converged=True,
        saturated=saturated_groups(weights, problem.groups),
        regularisation=factor,
    )

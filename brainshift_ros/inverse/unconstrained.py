"""Least squares (3.5) and Tikhonov regularisation (3.7), (3.8): no bounds on the weights, no sum limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.inverse.problem import WeightProblem, WeightSolution, saturated_groups
from brainshift_ros.inverse.regularisation import Spectrum, gcv_factor, l_curve_factor

#: lambda of (3.8) when none is given and no automatic choice is asked for: in the study `inverse-methods`, the best of 1e-10
#: to 1 for subsurface targets at 1 mm of noise, and near it at 0.5 mm.
DEFAULT_LAMBDA = 1e-4


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
    factor = lambda_ * float(np.sum(problem.column_norms**2))
    return _solution(problem, Spectrum.of(problem).weights(factor), "tikhonov", factor)


def solve_tikhonov_gcv(problem: WeightProblem) -> WeightSolution:
    """Tikhonov regularisation with the factor that minimises generalised cross-validation."""
    spectrum = Spectrum.of(problem)
    factor = gcv_factor(spectrum)
    return _solution(problem, spectrum.weights(factor), "tikhonov_gcv", factor)


def solve_tikhonov_l_curve(problem: WeightProblem) -> WeightSolution:
    """Tikhonov regularisation with the factor at the corner of the L-curve."""
    spectrum = Spectrum.of(problem)
    factor = l_curve_factor(spectrum)
    return _solution(problem, spectrum.weights(factor), "tikhonov_l_curve", factor)


def _solution(problem: WeightProblem, weights: NDArray, method: str, factor: float) -> WeightSolution:
    """Optimality here is a vanishing gradient of ``||A a - b||^2 + factor ||a||^2``, scaled as in `kkt_residual`."""
    residual = problem.b - problem.A @ weights
    scale = max(float(problem.column_norms.max(initial=0.0) * np.linalg.norm(problem.b)), float(np.finfo(float).tiny))
    gradient = residual @ problem.A - factor * weights
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

"""Solvers by others for the constrained problem, kept as checks on the exact active set."""

from __future__ import annotations

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import nnls

from brainshift_ros.inverse.problem import WeightProblem, WeightSolution, kkt_residual, saturated_groups


def solve_nnls(problem: WeightProblem) -> WeightSolution:
    """SciPy's non-negative least squares, with each sum as a heavily weighted equation with a slack variable."""
    A, b, sums = _scaled(problem)
    count = len(problem.groups)
    heavy = 1e4
    rows = np.block([[A, np.zeros((len(b), count))], [heavy * sums, heavy * np.eye(count)]])
    answer, _ = nnls(rows, np.concatenate([b, heavy * problem.limits]), maxiter=50 * rows.shape[1])
    return _solution(problem, answer[: A.shape[1]], "nnls", 0, True)


def solve_osqp(problem: WeightProblem) -> WeightSolution:
    """OSQP (operator splitting) with polishing, on the residual form, which avoids the Gram matrix."""
    A, b, sums = _scaled(problem)
    rows, columns = A.shape
    quadratic = sparse.diags(np.concatenate([np.zeros(columns), np.ones(rows)]), format="csc")
    constraints = sparse.bmat(
        [[A, -sparse.eye(rows)], [sparse.eye(columns), None], [sums if len(sums) else None, None]], format="csc"
    )
    low = np.concatenate([b, np.zeros(columns), np.full(len(sums), -np.inf)])
    high = np.concatenate([b, np.full(columns, np.inf), problem.limits])
    solver = osqp.OSQP()
    solver.setup(
        quadratic, np.zeros(rows + columns), constraints, low, high,
        eps_abs=1e-9, eps_rel=1e-9, max_iter=50_000, polishing=True, verbose=False,
    )  # fmt: skip
    result = solver.solve(raise_error=False)
    solved = result.info.status == "solved"
    return _solution(problem, np.asarray(result.x[:columns]), "osqp", int(result.info.iter), solved)


def _scaled(problem: WeightProblem) -> tuple[NDArray, NDArray, NDArray]:
    """Divide A and b by the largest column norm, so that tolerances mean the same everywhere; also return the sum rows."""
    largest = float(np.linalg.norm(problem.A, axis=0).max(initial=0.0)) or 1.0
    sums = np.zeros((len(problem.groups), problem.A.shape[1]))
    for row, group in zip(sums, problem.groups, strict=True):
        row[list(group.columns)] = 1.0
    return problem.A / largest, problem.b / largest, sums


def _solution(problem: WeightProblem, weights: NDArray, method: str, iterations: int, converged: bool) -> WeightSolution:
    return WeightSolution(
        weights=weights,
        method=method,
        residual_norm=float(np.linalg.norm(problem.A @ weights - problem.b)),
        kkt_residual=kkt_residual(problem, weights),
        iterations=iterations,
        converged=converged,
        saturated=saturated_groups(weights, problem.groups),
    )

"""Solvers by others for the constrained problem, kept as checks on the exact active set.

All of them see A and b divided by the largest column norm, so that their tolerances mean the same everywhere, and condensed
rows where there are many.
"""

from __future__ import annotations

import clarabel
import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import nnls

from brainshift_ros.inverse.condensing import condensed
from brainshift_ros.inverse.problem import WeightProblem, WeightSolution, kkt_residual, saturated_groups

#: Weight of a sum's equation against the rows of the fit, for a solver that knows no equations.
_HEAVY = 1e4


def solve_nnls(problem: WeightProblem) -> WeightSolution:
    """SciPy's non-negative least squares (Lawson and Hanson), each sum a heavily weighted equation with a slack variable."""
    A, b, sums = _scaled(problem)
    count = len(problem.groups)
    rows = np.block([[A, np.zeros((len(b), count))], [_HEAVY * sums, _HEAVY * np.eye(count)]])
    answer, _ = nnls(rows, np.concatenate([b, _HEAVY * problem.limits]), maxiter=50 * rows.shape[1])
    return _solution(problem, answer[: A.shape[1]], "nnls", 0, True)


def solve_osqp(problem: WeightProblem) -> WeightSolution:
    """OSQP (operator splitting, first order) with polishing, on the residual form, which avoids the Gram matrix."""
    A, b, sums = _scaled(problem)
    rows, columns = A.shape
    constraints = sparse.bmat(
        [[A, -sparse.eye(rows)], [sparse.eye(columns), None], [sums if len(sums) else None, None]], format="csc"
    )
    low = np.concatenate([b, np.zeros(columns), np.full(len(sums), -np.inf)])
    high = np.concatenate([b, np.full(columns, np.inf), problem.limits])
    solver = osqp.OSQP()
    solver.setup(
        _residual_norm(rows, columns), np.zeros(rows + columns), constraints, low, high,
        eps_abs=1e-9, eps_rel=1e-9, max_iter=10_000, polishing=True, verbose=False,
    )  # fmt: skip
    result = solver.solve(raise_error=False)
    solved = result.info.status == "solved"
    return _solution(problem, np.asarray(result.x[:columns]), "osqp", int(result.info.iter), solved)


def solve_clarabel(problem: WeightProblem) -> WeightSolution:
    """Clarabel (primal-dual interior point), on the residual form."""
    A, b, sums = _scaled(problem)
    rows, columns = A.shape
    constraints = sparse.bmat(
        [[A, -sparse.eye(rows)], [-sparse.eye(columns), None], [sums if len(sums) else None, None]], format="csc"
    )
    right = np.concatenate([b, np.zeros(columns), problem.limits])
    cones = [clarabel.ZeroConeT(rows), clarabel.NonnegativeConeT(columns + len(sums))]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    result = clarabel.DefaultSolver(
        _residual_norm(rows, columns), np.zeros(rows + columns), constraints, right, cones, settings
    ).solve()
    solved = str(result.status) == "Solved"
    return _solution(problem, np.asarray(result.x[:columns]), "clarabel", int(result.iterations), solved)


def _scaled(problem: WeightProblem) -> tuple[NDArray, NDArray, NDArray]:
    """Return A and b divided by the largest column norm, and the sum rows."""
    small = condensed(problem) or problem
    largest = float(small.column_norms.max(initial=0.0)) or 1.0
    sums = np.zeros((len(problem.groups), problem.A.shape[1]))
    for row, group in zip(sums, problem.groups, strict=True):
        row[list(group.columns)] = 1.0
    return small.A / largest, small.b / largest, sums


def _residual_norm(rows: int, columns: int) -> sparse.csc_matrix:
    """Quadratic form of ``||r||^2 / 2`` over the variables (weights, r)."""
    return sparse.diags(np.concatenate([np.zeros(columns), np.ones(rows)]), format="csc")


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

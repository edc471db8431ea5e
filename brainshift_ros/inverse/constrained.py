"""Exact active set for (3.9) and (6.3): weights >= 0, and the sum over each group at most its limit.

The method of Lawson and Hanson (Solving Least Squares Problems, chapter 23) with sum rows in the working set: from a
feasible point, free the constraint whose multiplier promises the steepest descent, solve the equality-constrained least
squares of the working set, step as far as the constraints allow, and repeat. The objective falls at every outer step
and there are finitely many working sets, so it ends; a column that its rounded multiplier wrongly let in (a duplicate of
a column in the set) is refused until the next progress, as in Lawson and Hanson.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from brainshift_ros.inverse.problem import WeightProblem, WeightSolution, kkt_residual, saturated_groups

_EPS = float(np.finfo(np.float64).eps)


def solve_constrained(problem: WeightProblem) -> WeightSolution:
    """Solve the constrained problem exactly.

    Parameters
    ----------
    problem
        Any size and rank; many more rows than columns are first condensed to a triangular factor.

    Returns
    -------
    Weights that are exactly zero outside the working set; `kkt_residual` is evaluated on the original problem.
    """
    small = _condensed(problem)
    active_set = _ActiveSet(small)
    converged = active_set.run()
    weights = active_set.weights
    return WeightSolution(
        weights=weights,
        method="constrained",
        residual_norm=float(np.linalg.norm(problem.A @ weights - problem.b)),
        kkt_residual=kkt_residual(problem, weights),
        iterations=active_set.iterations,
        converged=converged,
        saturated=saturated_groups(weights, problem.groups),
    )


def _condensed(problem: WeightProblem) -> WeightProblem:
    """Return a problem with the same minimisers and at most m rows, by a pivoted Cholesky factor of the Gram matrix."""
    A, b = problem.A, problem.b
    rows, columns = A.shape
    if rows <= 2 * columns or not A.any():
        return problem
    factor, pivots, rank, _ = scipy.linalg.lapack.dpstrf(A.T @ A)  # upper R with P^T A^T A P = R^T R
    order = pivots - 1
    R = np.triu(factor)[:rank]
    condensed = np.zeros((rank, columns))
    condensed[:, order] = R
    right = scipy.linalg.solve_triangular(R[:, :rank], (A.T @ b)[order[:rank]], trans="T")
    return replace(problem, A=condensed, b=right)


class _ActiveSet:
    """State of the iteration: the weights, the free columns, and the groups held at their limit."""

    def __init__(self, problem: WeightProblem) -> None:
        self.A, self.b = problem.A, problem.b
        self.owner, self.limits = problem.group_of, problem.limits
        self.weights = np.zeros(self.A.shape[1])
        self.free: list[int] = []
        self.held: set[int] = set()
        self.iterations = 0
        norms = np.linalg.norm(self.A, axis=0)
        self._norms = np.where(norms > 0.0, norms, 1.0)
        self._tolerance = 10.0 * _EPS * max(self.A.shape) * max(float(np.linalg.norm(self.b)), np.finfo(float).tiny)

    def run(self) -> bool:
        """Iterate to the optimum; False if the limit on iterations, never seen to bind, stopped it."""
        refused: set[int] = set()
        limit = 20 * (self.A.shape[1] + len(self.limits)) + 100
        while self.iterations < limit:
            candidate = self._most_promising(refused)
            if candidate is None:
                return True
            before = self._objective()
            if candidate < 0:
                self.held.discard(-1 - candidate)
            else:
                self.free.append(candidate)
            self._descend()
            if self._objective() < before:
                refused.clear()
            else:
                refused.add(candidate)
        return False

    def _objective(self) -> float:
        residual = self.b - self.A[:, self.free] @ self.weights[self.free]
        return float(residual @ residual)

    def _most_promising(self, refused: set[int]) -> int | None:
        """Return a column to free, ``-1 - group`` for a sum to release, or None at the optimum."""
        residual = self.b - self.A[:, self.free] @ self.weights[self.free]
        descent = self.A.T @ residual
        multiplier = np.zeros(len(self.limits))
        for group in self.held:
            members = [column for column in self.free if self.owner[column] == group]
            multiplier[group] = float(np.mean(descent[members]))
        scale = float(self._norms.max())
        promise = descent - np.where(self.owner >= 0, np.append(multiplier, 0.0)[self.owner], 0.0)
        # A column's promise is the difference of two products, so its round-off grows with the larger column's norm.
        promise /= np.maximum(self._norms, np.where(np.isin(self.owner, list(self.held)), scale, 0.0))
        promise[self.free] = -np.inf
        promise[[column for column in refused if column >= 0]] = -np.inf
        best = int(np.argmax(promise)) if promise.size else -1
        value = promise[best] if promise.size else -np.inf
        for group in self.held:
            if -multiplier[group] / scale > max(value, self._tolerance) and -1 - group not in refused:
                best, value = -1 - group, -multiplier[group] / scale
        return best if value > self._tolerance else None

    def _descend(self) -> None:
        """Move to the working set's minimiser, giving up constraints on the way that would be violated."""
        while True:
            self.iterations += 1
            target = self._minimiser()
            current = self.weights[self.free]
            step, blocking = self._largest_step(current, target)
            self.weights[self.free] = current + step * (target - current)
            if blocking is None:
                return
            if blocking < 0:
                self.held.add(-1 - blocking)
            else:
                self.weights[blocking] = 0.0
                self.free.remove(blocking)
                self._release_empty_groups()

    def _largest_step(self, current: NDArray, target: NDArray) -> tuple[float, int | None]:
        """Share of the way to the target that stays feasible, and what blocks there (a column, or ``-1 - group``)."""
        step, blocking = 1.0, None
        for position, column in enumerate(self.free):
            if target[position] <= 0.0:
                fall = current[position] - target[position]
                share = current[position] / fall if fall > 0.0 else 0.0
                if share < step or blocking is None:
                    step, blocking = min(share, step), column
        free_owner = self.owner[self.free]
        for group, limit in enumerate(self.limits):
            members = free_owner == group
            if group in self.held or not members.any():
                continue
            now, then = current[members].sum(), target[members].sum()
            if then > limit * (1.0 + 4.0 * _EPS):
                share = max(0.0, (limit - now) / (then - now))
                if share < step or blocking is None:
                    step, blocking = min(share, step), -1 - group
        return step, blocking

    def _release_empty_groups(self) -> None:
        """Release a held sum that has no free column left to carry it."""
        present = {int(self.owner[column]) for column in self.free}
        self.held &= present

    def _minimiser(self) -> NDArray[np.float64]:
        """Least squares over the free columns with the held sums as equations, which eliminate one column each.

        Eliminating the column with the largest weight of each held group keeps the rest well scaled; a QR based
        solver then works on A itself, not on its Gram matrix, whose condition is the square.
        """
        columns = np.array(self.free, dtype=np.int64)
        A, right = self.A[:, columns].copy(), self.b
        owner = self.owner[columns]
        eliminated = np.zeros(len(columns), dtype=bool)
        pivot_of: dict[int, int] = {}
        for group in self.held:
            members = np.flatnonzero(owner == group)
            pivot = int(members[np.argmax(self.weights[columns[members]])])
            right = right - self.limits[group] * A[:, pivot]
            A[:, members] -= A[:, [pivot]]
            eliminated[pivot] = True
            pivot_of[group] = pivot
        target = np.zeros(len(columns))
        kept = ~eliminated
        if kept.any():
            target[kept] = np.linalg.lstsq(A[:, kept], right, rcond=None)[0]
        for group, pivot in pivot_of.items():
            target[pivot] = self.limits[group] - target[kept & (owner == group)].sum()
        return target

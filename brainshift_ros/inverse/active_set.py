"""Active-set iteration for (3.9) and (6.3): weights >= 0, and the sum over each group at most its limit.

The method of Lawson and Hanson (Solving Least Squares Problems, chapter 23) with sum rows in the working set: from a
feasible point, free the constraint whose multiplier promises the steepest descent, solve the equality-constrained least
squares of the working set, step as far as the constraints allow, and repeat. The objective falls at every outer step
and there are finitely many working sets, so it ends; a column that its rounded multiplier wrongly let in (a duplicate of
a column in the set) is refused until the next progress, as in Lawson and Hanson.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from brainshift_ros.inverse.problem import WeightProblem

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)

#: What counts as round-off, in units of the machine precision times the size of the terms that were summed.
_ROUND_OFF = 8.0


class ActiveSet:
    """State of the iteration: the weights, the free columns, and the groups held at their limit.

    Parameters
    ----------
    problem
        Any size and rank.
    start
        Shape (m,), feasible weights to start from; zeros if None.

    Attributes
    ----------
    weights
        Shape (m,), feasible after every iteration; exactly zero outside the working set.
    iterations
        Least-squares problems solved so far.
    """

    def __init__(self, problem: WeightProblem, start: NDArray[np.float64] | None = None) -> None:
        self._A, self._b = problem.A, problem.b
        self._owner, self._limits = problem.group_of, problem.limits
        self._norms = problem.column_norms
        self.weights = np.zeros(self._A.shape[1]) if start is None else start.copy()
        self._free = [int(column) for column in np.flatnonzero(self.weights)]
        self._held = np.zeros(len(self._limits), dtype=bool)
        self.iterations = 0
        self._measured = max(float(np.linalg.norm(self._b)), _TINY)
        if self._free:
            self._hold_full_groups()
            self._descend()

    def run(self) -> bool:
        """Iterate to the optimum; False if the limit on iterations, never seen to bind, stopped it."""
        refused: set[int] = set()
        limit = 20 * (self._A.shape[1] + len(self._limits)) + 100
        residual = self._residual()
        while self.iterations < limit:
            candidate = self._most_promising(residual, refused)
            if candidate is None:
                return True
            if candidate < 0:
                self._held[-1 - candidate] = False
            else:
                self._free.append(candidate)
            self._descend()
            before, residual = residual, self._residual()
            if residual @ residual < before @ before:
                refused.clear()
            else:
                refused.add(candidate)
        return False

    def _residual(self) -> NDArray[np.float64]:
        return np.asarray(self._b - self._A[:, self._free] @ self.weights[self._free])

    def _hold_full_groups(self) -> None:
        """Put the sums that the start reaches into the working set."""
        for group, limit in enumerate(self._limits):
            total = self.weights[self._owner == group].sum()
            self._held[group] = total >= limit * (1.0 - _ROUND_OFF * _EPS)

    def _most_promising(self, residual: NDArray[np.float64], refused: set[int]) -> int | None:
        """Return a column to free, ``-1 - group`` for a sum to release, or None at the optimum."""
        descent = residual @ self._A
        # Of the residual: the difference of the measured and of what the free columns add up to.
        round_off = _ROUND_OFF * _EPS * (self._measured + float(self.weights @ self._norms))
        promise, size, worst, choice = descent.copy(), self._norms.copy(), 0.0, None
        if self._held.any():
            free = np.array(self._free)
            for group in np.flatnonzero(self._held):
                members = free[self._owner[free] == group]
                multiplier = float(self.weights[members] @ descent[members] / self.weights[members].sum())
                largest = float(self._norms[members].max())
                inside = self._owner == group
                promise[inside] -= multiplier
                # What enters takes the place of a free column, so its direction is the difference of the two.
                size[inside] = np.maximum(size[inside], largest)
                gain = -multiplier / max(largest, _TINY)
                if gain > max(worst, round_off) and -1 - group not in refused:
                    worst, choice = gain, -1 - int(group)
        promise /= np.maximum(size, _TINY)
        promise[self._free] = -np.inf
        promise[[column for column in refused if column >= 0]] = -np.inf
        best = int(np.argmax(promise))
        return best if promise[best] > max(worst, round_off) else choice

    def _descend(self) -> None:
        """Move to the working set's minimiser, giving up constraints on the way that would be violated."""
        while self._free:
            self.iterations += 1
            free = np.array(self._free)
            current, step = self.weights[free], self._step(free)
            share, blocking = self._largest_share(free, current, step)
            self.weights[free] = np.maximum(current + share * step, 0.0)
            if blocking is None:
                return
            if blocking < 0:
                self._held[-1 - blocking] = True
            else:
                self.weights[blocking] = 0.0
                self._free.remove(blocking)

    def _largest_share(self, free: NDArray, current: NDArray, step: NDArray) -> tuple[float, int | None]:
        """Share of the step that stays feasible, and what blocks there (a column, or ``-1 - group``; None: nothing)."""
        share, blocking = 1.0, None
        falling = np.flatnonzero((current + step <= 0.0) & (step <= 0.0))
        if falling.size:
            ratios = current[falling] / np.maximum(-step[falling], _TINY)
            first = int(np.argmin(ratios))
            share, blocking = min(float(ratios[first]), 1.0), int(free[falling[first]])
        for group in np.flatnonzero(~self._held):
            members = self._owner[free] == group
            now, rise = float(current[members].sum()), float(step[members].sum())
            if now + rise > self._limits[group] * (1.0 + 4.0 * _EPS):
                reach = max(0.0, (self._limits[group] - now) / rise) if rise > 0.0 else 0.0
                if reach < share or blocking is None:
                    share, blocking = min(share, reach), -1 - int(group)
        return share, blocking

    def _step(self, free: NDArray[np.int64]) -> NDArray[np.float64]:
        """Step to the least squares over the free columns with the held sums as equations, which eliminate one column each.

        Solving for the step and not for the weights themselves keeps round-off as small as the last step. Eliminating the
        column with the largest weight of each held group keeps the rest well scaled.
        """
        columns = self._A[:, free]
        residual = self._b - columns @ self.weights[free]
        sizes = self._norms[free]
        step = np.zeros(len(free))
        if not self._held.any():
            return _least_squares(columns, residual, sizes)
        owner = self._owner[free]
        kept = np.ones(len(free), dtype=bool)
        pivots: list[tuple[int, NDArray[np.int64], float]] = []
        for group in np.flatnonzero(self._held):
            members = np.flatnonzero(owner == group)
            weights = self.weights[free[members]]
            pivot = int(members[np.argmax(weights)])
            others = members[members != pivot]
            missing = float(self._limits[group] - weights.sum())
            residual -= missing * columns[:, pivot]
            columns[:, others] -= columns[:, [pivot]]
            sizes[others] = np.maximum(sizes[others], sizes[pivot])
            kept[pivot] = False
            pivots.append((pivot, others, missing))
        if kept.any():
            step[kept] = _least_squares(columns[:, kept], residual, sizes[kept])
        for pivot, others, missing in pivots:
            step[pivot] = missing - step[others].sum()
        return step


def _least_squares(A: NDArray[np.float64], b: NDArray[np.float64], sizes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least squares by QR, or of minimum norm by SVD if the columns are dependent as far as round-off can tell.

    Parameters
    ----------
    A, b
        Shapes (r, k) and (r,).
    sizes
        Shape (k,), size of the terms whose sum or difference each column is: its round-off is in proportion.
    """
    rows, count = A.shape
    if count <= rows:
        factor, solution, failed = lapack.dgels(A, b)
        # A diagonal entry of R is the length of a column's part that the columns before it cannot make.
        own = np.abs(np.diagonal(factor))
        if failed == 0 and (own > _ROUND_OFF * _EPS * np.sqrt(rows) * sizes).all():
            return np.asarray(solution[:count])
    scale = np.maximum(sizes, _TINY)
    return np.asarray(np.linalg.lstsq(A / scale, b, rcond=_ROUND_OFF * _EPS * np.sqrt(rows))[0] / scale)

"""The dense systems that one Schur complement gives under different constraints, two-sided and one-sided."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.solvers.contact import ContactProblem
from brainshift_ros.solvers.held import HeldSystem, SchurComplement
from brainshift_ros.solvers.threads import one_blas_thread

#: Factors of this many bytes are kept for sets that come again, as they do in every time step.
CACHE_BYTES = 2**29


class ConstraintSet:
    """``S x = g`` under one set of constraints, two-sided and one-sided.

    Parameters
    ----------
    schur
        S, shape (v, v).
    held
        Shape (v,), dofs that are zero.
    one_sided
        Shape (v,), dofs that are not positive, their reaction ``S x - g`` neither.
    """

    def __init__(self, schur: SchurComplement, held: NDArray[np.bool_], one_sided: NDArray[np.bool_]) -> None:
        self._schur, self._held = schur, held
        self._one_sided, self._free = np.flatnonzero(one_sided & ~held), np.flatnonzero(~one_sided & ~held)
        self._two_sided = HeldSystem(schur, held | one_sided)
        self.bytes = self._two_sided.bytes
        if len(self._one_sided):
            # The free dofs are eliminated, which leaves a contact problem on the one-sided ones alone.
            stiffness = schur.matrix[np.ix_(self._one_sided, self._one_sided)]
            self._coupling = schur.matrix[np.ix_(self._one_sided, self._free)]
            follow = self._two_sided.solve(schur.matrix[:, self._one_sided])[self._free]
            stiffness -= self._coupling @ follow
            self._contact = ContactProblem(0.5 * (stiffness + stiffness.T))
            self.bytes += 2 * stiffness.nbytes + self._coupling.nbytes

    def solve(
        self, load: NDArray[np.float64], guess: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int64]]:
        """Solve for loads (v, k).

        Parameters
        ----------
        load
            Shape (v, k).
        guess
            Shape (v, k), dofs that may be closed, to start from; or (v,) for the first load, the others then start from
            the one before.

        Returns
        -------
        Solutions (v, k), closed dofs (v, k), and the number of sets of closed dofs that each load needed (k,).
        """
        count = load.shape[1]
        closed = np.zeros(load.shape, dtype=bool)
        iterations = np.zeros(count, dtype=np.int64)
        if len(self._one_sided) == 0:
            return self._two_sided.solve(load), closed, iterations
        condensed = load[self._one_sided] - self._coupling @ self._two_sided.solve(load)[self._free]
        contact = np.empty((len(self._one_sided), count))
        touching = guess[self._one_sided]
        for column in range(count):
            if guess.ndim == 2:
                touching = guess[self._one_sided, column]
            state = self._contact.solve(condensed[:, column], touching)
            contact[:, column], iterations[column], touching = state.displacement, state.iterations, state.closed
            closed[self._one_sided, column] = touching
        rest = load.copy()
        rest[self._free] -= self._coupling.T @ contact
        solution = self._two_sided.solve(rest)
        solution[self._one_sided] = contact
        return solution, closed, iterations

    def solve_linear(self, load: NDArray[np.float64], closed: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Solve for loads (v, k) with the closed dofs (v, k) of each held as well, the other one-sided ones free."""
        if len(self._one_sided) == 0:
            return self._two_sided.solve(load)
        columns = [HeldSystem(self._schur, self._held | c).solve(f[:, None]) for f, c in zip(load.T, closed.T, strict=True)]
        return np.concatenate(columns, axis=1)


class CondensedSystem:
    """``S x = g`` for many loads under a few sets of constraints.

    Parameters
    ----------
    matrix
        S, shape (v, v), symmetric.
    definite
        Positive definite under every set; else quasi-definite.
    held, one_sided
        Shape (s, v), see :class:`ConstraintSet`. Equal sets are one.
    """

    def __init__(
        self, matrix: NDArray[np.float64], definite: bool, held: NDArray[np.bool_], one_sided: NDArray[np.bool_]
    ) -> None:
        self._schur = SchurComplement(matrix, definite)
        both, self._number = np.unique(np.concatenate([held, one_sided], axis=1), axis=0, return_inverse=True)
        self._held, self._one_sided = np.split(both, 2, axis=1)
        self._kept: OrderedDict[int, ConstraintSet] = OrderedDict()
        self._guess = np.zeros(len(matrix), dtype=bool)

    def solve(
        self, load: NDArray[np.float64], sets: NDArray[np.int64], guess: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int64]]:
        """Solve for loads (v, k) under their sets (k,).

        `guess` (v, k) are dofs that may be closed; without it each load starts from the one before.

        Returns
        -------
        Solutions (v, k), closed dofs (v, k), and the number of sets of closed dofs that each load needed (k,).
        """
        solution, closed = np.empty_like(load), np.zeros(load.shape, dtype=bool)
        iterations = np.zeros(load.shape[1], dtype=np.int64)
        with one_blas_thread():
            for constraints, columns in self._by_set(sets):
                start = self._guess if guess is None else guess[:, columns]
                solution[:, columns], closed[:, columns], iterations[columns] = constraints.solve(load[:, columns], start)
                self._guess = closed[:, columns[-1]]
        return solution, closed, iterations

    def solve_linear(
        self, load: NDArray[np.float64], sets: NDArray[np.int64], closed: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Solve for loads (v, k) with the closed dofs (v, k) of each held as well, the other one-sided ones free."""
        solution = np.empty_like(load)
        with one_blas_thread():
            for constraints, columns in self._by_set(sets):
                solution[:, columns] = constraints.solve_linear(load[:, columns], closed[:, columns])
        return solution

    def _by_set(self, sets: NDArray[np.int64]) -> Iterator[tuple[ConstraintSet, NDArray[np.int64]]]:
        number_of_column = self._number[sets]
        for number in np.unique(number_of_column):
            yield self._set(int(number)), np.flatnonzero(number_of_column == number)

    def _set(self, number: int) -> ConstraintSet:
        if number in self._kept:
            self._kept.move_to_end(number)
        else:
            self._kept[number] = ConstraintSet(self._schur, self._held[number], self._one_sided[number])
            while len(self._kept) > 1 and sum(kept.bytes for kept in self._kept.values()) > CACHE_BYTES:
                self._kept.popitem(last=False)
        return self._kept[number]

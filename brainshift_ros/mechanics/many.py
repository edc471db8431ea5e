"""Many solutions on one set of elements: one factorisation, though each may free other skull nodes.

The stiffness matrix is the same for every head orientation. What changes is the load, and which skull normals are held at
zero. Dofs that are held in some cases and free in others ("variable") are kept out of the one sparse elimination, which
leaves their dense Schur complement S. A case that frees the subset F of them condenses its load to g, solves
``S_FF u_F = g_F`` by a dense Cholesky factorisation, and recovers the rest by back substitution. It is static
condensation, exact to round-off: no approximation enters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from brainshift_ros.mechanics.solvers import (
    BLOCK,
    Condensation,
    SolverName,
    assert_residual,
    condense,
    factorize,
    relative_residual,
)


class ManySolver:
    """Solve ``K u = f`` for many loads under a few sets of constraints.

    Parameters
    ----------
    stiffness
        Sparse (n, n), SPD once any of the constraint sets is held.
    constraint_sets
        Shape (s, n), boolean; the dofs that each set holds at zero.
    solver
        ``auto``, ``pardiso`` or ``scipy``.

    Attributes
    ----------
    variable_count
        Number of dofs that some sets hold and others leave free.
    name
        The solver that is used.
    """

    def __init__(self, stiffness: sp.csr_matrix, constraint_sets: NDArray[np.bool_], solver: SolverName = "auto") -> None:
        self._sets = constraint_sets
        self._active = np.flatnonzero(~np.all(constraint_sets, axis=0))
        self._matrix = stiffness[self._active][:, self._active].tocsr()
        variable: NDArray[np.bool_] = np.any(constraint_sets, axis=0)[self._active]
        self._variable = np.flatnonzero(variable)
        self.variable_count = len(self._variable)
        self._condensation: Condensation | None = None
        if self.variable_count:
            self._condensation = condense(self._matrix, variable, solver)
            self.name = self._condensation.name
        else:
            self._factorization = factorize(self._matrix, solver)
            self.name = self._factorization.name

    def solve(
        self,
        set_of_case: Sequence[int],
        loads: Callable[[Sequence[int]], NDArray[np.float64]],
    ) -> Iterator[tuple[list[int], NDArray[np.float64], float]]:
        """Solve all cases in blocks; cases of one constraint set share its dense factorisation.

        Parameters
        ----------
        set_of_case
            Constraint set of each case.
        loads
            Gives the loads (n, k) of some cases by their numbers.

        Yields
        ------
        The block's case numbers, their solutions (n, k), and the block's largest relative residual.

        Raises
        ------
        ArithmeticError
            A block's residual is too large.
        """
        cases = sorted(range(len(set_of_case)), key=lambda case: set_of_case[case])
        for start in range(0, len(cases), BLOCK):
            block = cases[start : start + BLOCK]
            sets = np.array([set_of_case[case] for case in block])
            rhs = loads(block)
            solution = np.zeros_like(rhs)
            solution[self._active] = self._solve_block(rhs[self._active], sets)
            residual = self._residual(solution, rhs, sets)
            assert_residual(residual, self.name)
            yield block, solution, residual

    def _solve_block(self, rhs: NDArray[np.float64], sets: NDArray[np.int64]) -> NDArray[np.float64]:
        if self._condensation is None:
            return self._factorization.solve(rhs)
        work = self._condensation.forward(rhs)
        condensed = work[self._variable]
        for chosen in np.unique(sets):
            columns = np.flatnonzero(sets == chosen)
            free = np.flatnonzero(~self._sets[chosen][self._active[self._variable]])
            values = np.zeros((self.variable_count, len(columns)))
            if len(free):
                factor = cho_factor(self._condensation.schur[np.ix_(free, free)], overwrite_a=True, check_finite=False)
                values[free] = cho_solve(factor, condensed[np.ix_(free, columns)], check_finite=False)
            work[np.ix_(self._variable, columns)] = values
        return self._condensation.backward(work)

    def _residual(self, solution: NDArray[np.float64], rhs: NDArray[np.float64], sets: NDArray[np.int64]) -> float:
        # Rows of held dofs carry the reaction: they are no equations.
        equations = ~self._sets[sets][:, self._active].T
        return relative_residual(self._matrix, solution[self._active], rhs[self._active], equations)

"""Many solutions on one set of elements: one factorisation, though each may free or bound other dofs.

The matrix is the same for every head orientation. What changes is the load, and which dofs are held at zero, bounded on
one side, or free. Dofs whose status varies are kept out of the one sparse elimination, which leaves their dense Schur
complement S. A case condenses its load to g, solves the small dense system that its constraints leave of ``S u = g``
(:mod:`.condensed`, :mod:`.contact`), and recovers the rest by back substitution. It is static condensation, exact to
round-off: no approximation enters, and every residual is checked on the whole matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.solvers.condensed import CondensedSystem
from brainshift_ros.solvers.direct import (
    BLOCK,
    Condensation,
    Factorization,
    SolverName,
    assert_residual,
    condense,
    equilibration,
    factorize,
    resolve,
)
from brainshift_ros.solvers.product import BlockProduct, MklProduct, SciPyProduct

#: A larger relative residual is worth a step of iterative refinement, of which there are at most this many.
REFINED = 1e-10
MOST_REFINEMENTS = 3

#: Rows that are copied at once between row and column order: few enough to stay in the cache.
_ROWS = 256


@dataclass(frozen=True)
class Block:
    """Some cases' solutions.

    Attributes
    ----------
    cases
        Their numbers, k of them.
    solution
        Shape (n, k).
    residual
        Largest relative residual of the equations and of the contact conditions.
    closed
        Shape (n, k), one-sided dofs that are at their bound; None where nothing is one-sided.
    iterations
        Shape (k,), sets of closed dofs that were tried; zero without contact.
    """

    cases: list[int]
    solution: NDArray[np.float64]
    residual: float
    closed: NDArray[np.bool_] | None
    iterations: NDArray[np.int64]


class ManySolver:
    """Solve ``A x = f`` for many loads under a few sets of constraints.

    Parameters
    ----------
    matrix
        Sparse (n, n), symmetric; positive definite once any of the constraint sets is held.
    held
        Shape (s, n), boolean; the dofs that each set holds at zero. The reaction takes the place of their equation.
    one_sided
        Shape (s, n), boolean; dofs with ``x <= 0`` whose reaction ``A x - f`` is not positive either, and zero where x is
        not: contact with something that can push, but not pull. Of a dof that is held too, held counts.
    solver
        ``auto``, ``pardiso`` or ``scipy``.
    definite
        False for a quasi-definite matrix ``[[A, B], [B^T, -C]]``; one-sided dofs are then of the first kind.

    Attributes
    ----------
    variable_count
        Number of dofs whose status is not the same, held or free, in all sets.
    name
        The solver that is used.

    Raises
    ------
    ArithmeticError
        The matrix cannot be factorised.
    """

    def __init__(
        self,
        matrix: sp.csr_matrix,
        held: NDArray[np.bool_],
        one_sided: NDArray[np.bool_] | None = None,
        solver: SolverName = "auto",
        *,
        definite: bool = True,
    ) -> None:
        bounded: NDArray[np.bool_] = np.zeros_like(held) if one_sided is None else one_sided & ~held
        self._is_contact = one_sided is not None
        self._active = np.flatnonzero(~held.all(axis=0))
        variable: NDArray[np.bool_] = np.any(held[:, self._active] | bounded[:, self._active], axis=0)
        self._variable = np.flatnonzero(variable)
        self._variable_rows = self._active[self._variable]
        self.variable_count = len(self._variable)
        self._held, self._bounded = held[:, self._variable_rows], bounded[:, self._variable_rows]
        reduced = matrix[self._active][:, self._active].tocsr()
        self._scale: NDArray[np.float64] | None = None
        if not definite:
            self._scale = equilibration(reduced)
            reduced = (sp.diags(self._scale) @ reduced @ sp.diags(self._scale)).tocsr()
        self._weight = np.zeros(matrix.shape[0])
        self._weight[self._active] = 1.0 if self._scale is None else self._scale
        self._square_weight = self._weight**2
        self._square_weight[self._variable_rows] = 0.0
        self._condensation: Condensation | None = None
        self._factorization: Factorization | None = None
        self.name: str = resolve(solver)
        if self.variable_count:
            self._condensation = condense(reduced, variable, solver, definite=definite)
            self._dense = CondensedSystem(self._condensation.schur, definite, self._held, self._bounded)
        elif len(self._active):
            self._factorization = factorize(reduced, solver, definite=definite)
        self._product: BlockProduct = MklProduct(matrix) if self.name == "pardiso" else SciPyProduct(matrix)

    def solve(
        self,
        set_of_case: Sequence[int],
        loads: Callable[[Sequence[int]], NDArray[np.float64]],
    ) -> Iterator[Block]:
        """Solve all cases in blocks; cases of one constraint set share its dense factorisation.

        Parameters
        ----------
        set_of_case
            Constraint set of each case.
        loads
            Gives the loads (n, k) of some cases by their numbers.

        Raises
        ------
        InputError
            A load is not finite.
        ArithmeticError
            A block's residual is too large, or a set's constraints leave the matrix singular.
        """
        cases = sorted(range(len(set_of_case)), key=lambda case: set_of_case[case])
        for start in range(0, len(cases), BLOCK):
            block = cases[start : start + BLOCK]
            yield replace(self.solve_block(loads(block), [set_of_case[case] for case in block]), cases=block)

    def solve_block(self, rhs: NDArray[np.float64], set_of_column: ArrayLike, guess: NDArray[np.bool_] | None = None) -> Block:
        """Solve for one block of loads.

        Parameters
        ----------
        rhs
            Shape (n, k), loads; on held dofs they do not matter, but must be finite.
        set_of_column
            Shape (k,), constraint set of each.
        guess
            Shape (n, k), one-sided dofs that may be closed, such as an earlier time step's; only the time depends on it.

        Raises
        ------
        InputError, ArithmeticError
            As :meth:`solve`.
        """
        sets = np.asarray(set_of_column, dtype=np.int64)
        norm = self._norm(rhs, rhs[self._variable_rows] * ~self._held[sets].T)
        if not np.isfinite(norm).all():
            raise InputError("loads", "they are not finite", "check the material's properties and the mesh")
        closed = np.zeros((self.variable_count, len(sets)), dtype=bool)
        iterations = np.zeros(len(sets), dtype=np.int64)

        def condensed(load: NDArray[np.float64]) -> NDArray[np.float64]:
            start = None if guess is None else guess[self._variable_rows]
            solution, closed[:], iterations[:] = self._dense.solve(load, sets, start)
            return solution

        solution = self._substitute(rhs, condensed)
        residual, error = self._residual(solution, rhs, sets, closed, norm)
        for _ in range(MOST_REFINEMENTS):
            if not REFINED < error < np.inf:
                break
            solution -= self._substitute(residual, lambda load: self._dense.solve_linear(load, sets, closed))
            residual, error = self._residual(solution, rhs, sets, closed, norm)
        assert_residual(error, self.name)
        return Block(list(range(len(sets))), solution, error, self._spread(closed), iterations)

    def _substitute(
        self, rhs: NDArray[np.float64], condensed: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Solve for (n, k), given how the condensed system is solved."""
        work = np.empty((len(self._active), rhs.shape[1]), order="F")
        for rows in _chunks(len(work)):
            work[rows] = rhs[self._active[rows]]
        if self._scale is not None:
            work *= self._scale[:, None]
        if self._condensation is not None:
            work = self._condensation.forward(work)
            work[self._variable] = condensed(work[self._variable])
            work = self._condensation.backward(work)
        elif self._factorization is not None:
            work = self._factorization.solve(work)
        if self._scale is not None:
            work *= self._scale[:, None]
        solution = np.zeros(rhs.shape)
        for rows in _chunks(len(work)):
            solution[self._active[rows]] = work[rows]
        return solution

    def _norm(self, rows: NDArray[np.float64], variable: NDArray[np.float64]) -> NDArray[np.float64]:
        """Norm (k,) of (n, k), equilibrated as the matrix; `variable` (v, k) takes the place of the variable rows."""
        scaled = variable * self._weight[self._variable_rows, None]
        fixed_rows = np.einsum("nk,nk,n->k", rows, rows, self._square_weight)
        return np.sqrt(fixed_rows + np.einsum("vk,vk->k", scaled, scaled))

    def _residual(
        self,
        solution: NDArray[np.float64],
        rhs: NDArray[np.float64],
        sets: NDArray[np.int64],
        closed: NDArray[np.bool_],
        norm: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], float]:
        """Give ``A x - f`` (n, k), zero on variable rows with a reaction, and the largest relative error of a column."""
        residual = self._product.residual(solution, rhs)
        reaction = residual[self._variable_rows]
        equations = reaction * ~(self._held[sets].T | closed)
        residual[self._variable_rows] = equations
        error = self._norm(residual, equations)
        if self._is_contact:
            weighted = reaction * self._weight[self._variable_rows, None]
            pull = np.max(weighted, axis=0, initial=0.0, where=closed)
            bounded = solution[self._variable_rows] * self._bounded[sets].T
            crossing = _relative(np.max(bounded, axis=0, initial=0.0), np.max(np.abs(bounded), axis=0, initial=0.0))
            error = np.maximum(np.maximum(error, pull), crossing * norm)
        return residual, float(np.max(_relative(error, norm), initial=0.0))

    def _spread(self, closed: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        if not self._is_contact:
            return None
        mask = np.zeros((len(self._weight), closed.shape[1]), dtype=bool)
        mask[self._variable_rows] = closed
        return mask


def _relative(error: NDArray[np.float64], to: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors as shares of something, themselves where that is zero."""
    return error / np.where(to > 0.0, to, 1.0)


def _chunks(count: int) -> Iterator[slice]:
    return (slice(start, start + _ROWS) for start in range(0, count, _ROWS))

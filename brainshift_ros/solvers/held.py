"""Dense condensed systems of which some dofs are held at zero.

Where few dofs are free, ``S_FF u_F = g_F`` is solved (primal). Where few are held, the inverse C = S^-1, made once for all
sets, gives the forces that hold them, ``C_HH r_H = -(C g)_H``, and the displacement is ``C (g + r)`` (dual). Both are exact.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.solvers.dense import factorize_dense

#: The dual way is taken if the held dofs are fewer than this share of the free ones.
DUAL_SHARE = 0.5

#: An inverse is used if its product with the matrix is the identity to this.
INVERSE_ERROR = 1e-9


class SchurComplement:
    """A dense condensed matrix (v, v), and its inverse once it is asked for.

    Attributes
    ----------
    matrix
        Shape (v, v), symmetric.
    definite
        Positive definite under every constraint set; else quasi-definite.
    """

    def __init__(self, matrix: NDArray[np.float64], definite: bool) -> None:
        self.matrix, self.definite = matrix, definite

    @cached_property
    def inverse(self) -> NDArray[np.float64] | None:
        """The inverse, or None where only the constraints make the matrix regular."""
        try:
            inverse = factorize_dense(self.matrix.copy(order="F"), self.definite).inverse()
        except ArithmeticError:
            return None
        error = np.abs(self.matrix @ inverse - np.eye(len(inverse))).max(initial=0.0)
        return inverse if error < INVERSE_ERROR else None


class HeldSystem:
    """``S x = g`` with some dofs held at zero: those rows of S are no equations.

    Parameters
    ----------
    schur
        S, shape (v, v).
    held
        Shape (v,), boolean.

    Raises
    ------
    ArithmeticError
        What is left is singular: these constraints do not hold the body.
    """

    def __init__(self, schur: SchurComplement, held: NDArray[np.bool_]) -> None:
        self._held, self._free = np.flatnonzero(held), np.flatnonzero(~held)
        few_held = len(self._held) < DUAL_SHARE * len(self._free)
        self._inverse = schur.inverse if few_held else None
        if self._inverse is None:
            self._factor = factorize_dense(_part(schur.matrix, self._free), schur.definite)
        else:
            self._factor = factorize_dense(_part(self._inverse, self._held), schur.definite)
        self.bytes = 8 * len(self._free if self._inverse is None else self._held) ** 2

    def solve(self, load: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for loads (v, k); held rows of them do not matter, and of the solution are zero."""
        if self._inverse is None:
            solution = np.zeros_like(load)
            solution[self._free] = self._factor.solve(load[self._free])
        else:
            solution = self._inverse @ load
            solution -= self._inverse[:, self._held] @ self._factor.solve(solution[self._held])
            solution[self._held] = 0.0
        return solution


def _part(matrix: NDArray[np.float64], chosen: NDArray[np.int64]) -> NDArray[np.float64]:
    # Of a symmetric matrix the transpose is the same, and Fortran-ordered: LAPACK works in it without a copy.
    return matrix[np.ix_(chosen, chosen)].T

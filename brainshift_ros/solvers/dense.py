"""Dense factorisations of Schur complements, Cholesky or LU, that name a matrix that cannot be solved."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, lapack, lu_solve

#: A pivot of Cholesky's this small against its diagonal entry is round-off: the matrix is singular.
SINGULAR = 1e-13


class DenseFactor(Protocol):
    """A factorised symmetric matrix (m, m)."""

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides (m,) or (m, k)."""
        ...

    def inverse(self) -> NDArray[np.float64]:
        """Give the inverse, (m, m), both triangles filled."""
        ...


class Cholesky:
    """Cholesky factor of an SPD matrix, which it overwrites if that is Fortran-ordered.

    Raises
    ------
    ArithmeticError
        The matrix is not positive definite, or singular to round-off.
    """

    def __init__(self, matrix: NDArray[np.float64]) -> None:
        diagonal = matrix.diagonal().copy()
        try:
            self._factor, _ = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError as error:
            raise ArithmeticError(f"dense Cholesky: {error}: something must hold the body against rigid motion") from error
        if np.any(self._factor.diagonal() ** 2 <= SINGULAR * diagonal):
            raise ArithmeticError("dense Cholesky: singular to round-off: something must hold the body against rigid motion")

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides (m,) or (m, k)."""
        return cho_solve((self._factor, True), rhs, check_finite=False)

    def inverse(self) -> NDArray[np.float64]:
        """Give the inverse, (m, m), both triangles filled."""
        lower = np.tril(lapack.dpotri(self._factor, lower=1)[0])
        return lower + np.tril(lower, -1).T


class LU:
    """LU factors of an indefinite matrix, which they overwrite if that is Fortran-ordered.

    Raises
    ------
    ArithmeticError
        The matrix is singular.
    """

    def __init__(self, matrix: NDArray[np.float64]) -> None:
        self._factors, self._pivots = matrix, np.zeros(0, dtype=np.int32)
        if len(matrix) == 0:
            return  # LAPACK refuses an empty matrix
        self._factors, self._pivots, zero_pivot = lapack.dgetrf(matrix, overwrite_a=True)
        if zero_pivot:
            raise ArithmeticError("dense LU: the matrix is singular: something must hold the body against rigid motion")

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides (m,) or (m, k)."""
        return lu_solve((self._factors, self._pivots), rhs, check_finite=False)

    def inverse(self) -> NDArray[np.float64]:
        """Give the inverse, (m, m)."""
        return self.solve(np.eye(len(self._factors)))


def factorize_dense(matrix: NDArray[np.float64], definite: bool) -> DenseFactor:
    """Cholesky for a positive definite matrix, LU for an indefinite one; the matrix may be overwritten."""
    return Cholesky(matrix) if definite else LU(matrix)

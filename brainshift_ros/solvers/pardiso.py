"""MKL PARDISO for symmetric matrices, positive definite or not, with its Schur complement.

The library is called directly: the `pypardiso` wrapper knows neither separate phases nor the Schur complement, and compares
the whole matrix again before every solve.
"""

from __future__ import annotations

import ctypes
import weakref
from ctypes.util import find_library
from functools import lru_cache
from importlib import metadata

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

_SPD, _INDEFINITE = 2, -2
_ANALYSE, _FACTORISE, _SOLVE, _FORWARD, _DIAGONAL, _BACKWARD, _RELEASE = 11, 22, 33, 331, 332, 333, -1

#: iparm indices, zero-based (the manual counts from one).
_CUSTOM, _ORDERING, _PERTURBATION, _PIVOTING, _ZERO_BASED, _SCHUR = 0, 1, 9, 20, 34, 35
_METIS, _BUNCH_KAUFMAN = 2, 1

#: An indefinite matrix's pivots below 10 to minus this times its norm are replaced by that.
_SMALLEST_PIVOT = 13


class PardisoError(ArithmeticError):
    """PARDISO's own error code; -4 is a matrix that is not positive definite, -2 a lack of memory."""

    def __init__(self, code: int, phase: int) -> None:
        indefinite = "the matrix is not positive definite: something must hold the body against rigid motion"
        meaning = {-1: "inconsistent input", -2: "not enough memory", -4: indefinite}
        super().__init__(f"MKL PARDISO failed in phase {phase} with error {code} ({meaning.get(code, 'see its manual')})")


@lru_cache(maxsize=1)
def load_mkl() -> ctypes.CDLL:
    """Load the MKL library, from the system or from the `mkl` wheel.

    Raises
    ------
    OSError
        MKL is not installed, or not for this machine (it is x86-64 only).
    """
    mkl = ctypes.CDLL(_mkl_path())
    # With dynamic adjustment MKL was seen to use one thread whatever it was allowed.
    mkl.MKL_Set_Dynamic(ctypes.c_int(0))
    return mkl


def _mkl_path() -> str:
    on_system = find_library("mkl_rt")
    if on_system is not None:
        return on_system
    try:
        files = metadata.files("mkl") or []
    except metadata.PackageNotFoundError as error:
        raise OSError("no MKL on this system, and no mkl wheel") from error
    # pypardiso looks through the whole environment instead, which takes seconds.
    for file in files:
        if "mkl_rt." in file.name:
            return str(file.locate())
    raise OSError("the mkl wheel holds no mkl_rt library")


class Pardiso:
    """Factorisation of a symmetric matrix, optionally condensed to a set of retained dofs.

    Parameters
    ----------
    matrix
        Symmetric, both triangles stored.
    retained
        Boolean mask of dofs that are kept out of the elimination; None factorises everything.
    definite
        Positive definite (L L^T), else L D L^T with Bunch and Kaufman's pivoting; that wants entries of like size.

    Attributes
    ----------
    schur
        Dense Schur complement on the retained dofs in their ascending order, or None.
    """

    name = "pardiso"

    def __init__(self, matrix: sp.csr_matrix, retained: NDArray[np.bool_] | None = None, *, definite: bool = True) -> None:
        self._mkl = load_mkl()
        self._kind = _SPD if definite else _INDEFINITE
        upper = sp.triu(matrix, format="csr")
        upper.sort_indices()
        self.size = upper.shape[0]
        self._values = np.ascontiguousarray(upper.data, dtype=np.float64)
        self._starts = np.ascontiguousarray(upper.indptr, dtype=np.int32)
        self._columns = np.ascontiguousarray(upper.indices, dtype=np.int32)
        self._permutation = np.zeros(self.size, dtype=np.int32)
        self._handle = np.zeros(64, dtype=np.int64)
        self._iparm = np.zeros(64, dtype=np.int32)
        self._iparm[[_CUSTOM, _ORDERING, _ZERO_BASED]] = 1, _METIS, 1
        if not definite:
            self._iparm[[_PERTURBATION, _PIVOTING]] = _SMALLEST_PIVOT, _BUNCH_KAUFMAN
        self.schur: NDArray[np.float64] | None = None
        self._finalizer = weakref.finalize(self, _release, self._mkl, self._kind, self._handle, self._iparm, self.size)
        nothing = np.zeros((self.size, 1), order="F")
        if retained is None:
            self._call(_ANALYSE, nothing, nothing)
            self._call(_FACTORISE, nothing, nothing)
        else:
            self._permutation[retained] = 1
            self._iparm[_SCHUR] = 2
            count = int(retained.sum())
            schur = np.zeros((count, count), order="F")
            self._call(_ANALYSE, nothing, nothing)
            self._call(_FACTORISE, nothing, schur)
            self.schur = schur

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides of shape (n, k); only without retained dofs."""
        return self._substitute(_SOLVE, rhs)

    def forward(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Forward elimination of (n, k); the retained rows then hold the condensed right-hand side."""
        return self._substitute(_FORWARD, rhs)

    def backward(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Back substitution of (n, k), whose retained rows hold the solution there."""
        return self._substitute(_BACKWARD, rhs)

    def close(self) -> None:
        """Give MKL's memory back; also done when the object is collected."""
        self._finalizer()

    def _substitute(self, phase: int, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        # MKL reads the block column by column; a C-ordered block would be silently taken for its transpose.
        block = np.asfortranarray(rhs, dtype=np.float64)
        solution = np.empty_like(block)
        if block.size:  # MKL refuses none
            self._call(phase, block, solution)
        return solution

    def _call(self, phase: int, rhs: NDArray[np.float64], solution: NDArray[np.float64]) -> None:
        _pardiso(
            self._mkl,
            self._kind,
            phase,
            self._handle,
            self._iparm,
            self.size,
            (self._values, self._starts, self._columns, self._permutation),
            rhs,
            solution,
        )


def _pardiso(
    mkl: ctypes.CDLL,
    kind: int,
    phase: int,
    handle: NDArray[np.int64],
    iparm: NDArray[np.int32],
    size: int,
    matrix: tuple[NDArray, NDArray, NDArray, NDArray],
    rhs: NDArray[np.float64],
    solution: NDArray[np.float64],
) -> None:
    # maxfct, mnum, mtype, phase, n, nrhs, msglvl, error: PARDISO takes all of them by reference.
    scalars = np.array([1, 1, kind, phase, size, rhs.shape[1], 0, 0], dtype=np.int32)
    maxfct, mnum, mtype, phase_, n, nrhs, msglvl, error = (scalars[i:].ctypes.data for i in range(8))
    values, starts, columns, permutation = (array.ctypes.data for array in matrix)
    call = mkl["pardiso"]
    call.argtypes = [ctypes.c_void_p] * 16
    call.restype = None
    call(
        *(handle.ctypes.data, maxfct, mnum, mtype, phase_, n, values, starts, columns, permutation),
        *(nrhs, iparm.ctypes.data, msglvl, rhs.ctypes.data, solution.ctypes.data, error),
    )
    if scalars[7] != 0:
        raise PardisoError(int(scalars[7]), phase)


def _release(mkl: ctypes.CDLL, kind: int, handle: NDArray[np.int64], iparm: NDArray[np.int32], size: int) -> None:
    empty = np.zeros(1, dtype=np.float64)
    index = np.zeros(1, dtype=np.int32)
    _pardiso(mkl, kind, _RELEASE, handle, iparm, size, (empty, index, index, index), np.zeros((1, 1)), np.zeros((1, 1)))

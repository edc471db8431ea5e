"""Products of a sparse matrix with blocks of vectors, for residuals: by MKL where it is the solver.

MKL uses all processors and takes less than half of SciPy's processor time; else the check would cost as much as the solution.
"""

from __future__ import annotations

import ctypes
import weakref
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from brainshift_ros.solvers.pardiso import load_mkl

#: MKL's names (mkl_spblas.h) for: no transposition, general matrix, zero-based, row by row.
_AS_IT_IS, _GENERAL, _ZERO_BASED, _ROW_MAJOR = 10, 20, 0, 101


class _Description(ctypes.Structure):
    _fields_ = (("type", ctypes.c_int), ("mode", ctypes.c_int), ("diag", ctypes.c_int))


class BlockProduct(Protocol):
    """A sparse matrix A that multiplies blocks."""

    def residual(self, solution: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Give ``A X - B`` for X and B of shape (n, k), a new array."""
        ...


class SciPyProduct:
    """Products by SciPy."""

    def __init__(self, matrix: sp.csr_matrix) -> None:
        self._matrix = matrix

    def residual(self, solution: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Give ``A X - B`` for X and B of shape (n, k), a new array."""
        residual = self._matrix @ solution
        residual -= rhs
        return residual


class MklProduct:
    """Products by MKL's sparse BLAS, in the matrix's own memory.

    Raises
    ------
    ArithmeticError
        MKL refuses the matrix.
    """

    def __init__(self, matrix: sp.csr_matrix) -> None:
        self._mkl = load_mkl()
        self._arrays = (
            np.ascontiguousarray(matrix.indptr, dtype=np.int32),
            np.ascontiguousarray(matrix.indices, dtype=np.int32),
            np.ascontiguousarray(matrix.data, dtype=np.float64),
        )
        starts, columns, values = (array.ctypes.data for array in self._arrays)
        ends = starts + self._arrays[0].itemsize
        self._handle = ctypes.c_void_p()
        _check(
            self._mkl.mkl_sparse_d_create_csr(
                *(ctypes.byref(self._handle), _ZERO_BASED, *matrix.shape),
                *(ctypes.c_void_p(address) for address in (starts, ends, columns, values)),
            )
        )
        self._finalizer = weakref.finalize(self, self._mkl.mkl_sparse_destroy, self._handle)

    def residual(self, solution: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Give ``A X - B`` for X and B of shape (n, k), a new array."""
        x = np.ascontiguousarray(solution, dtype=np.float64)
        residual = np.array(rhs, dtype=np.float64, order="C")
        count = x.shape[1]
        if count:
            _check(
                self._mkl.mkl_sparse_d_mm(
                    *(_AS_IT_IS, ctypes.c_double(1.0), self._handle, _Description(_GENERAL, 0, 0), _ROW_MAJOR),
                    *(ctypes.c_void_p(x.ctypes.data), count, count),
                    *(ctypes.c_double(-1.0), ctypes.c_void_p(residual.ctypes.data), count),
                )
            )
        return residual


def _check(status: int) -> None:
    if status != 0:
        raise ArithmeticError(f"MKL's sparse BLAS failed with status {status}")

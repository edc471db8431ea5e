"""Direct solvers for the symmetric positive definite systems of elasticity, chosen by name."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.pardiso import Pardiso, load_mkl

SolverName = Literal["auto", "pardiso", "scipy"]

#: Right-hand sides that are solved together: enough to fill the processor, few enough to stay small in memory.
BLOCK = 128

#: Largest relative residual of a solution that is passed on.
RESIDUAL_LIMIT = 1e-8


class Factorization(Protocol):
    """A factorised SPD matrix: `solve` takes and gives (n, k)."""

    name: str

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for k right-hand sides."""
        ...


class Condensation(Protocol):
    """An SPD matrix factorised up to its Schur complement on some retained dofs (static condensation).

    Between `forward` and `backward` the retained rows are the caller's: they come as the condensed right-hand side g and
    must go back as the solution x of ``schur @ x = g``, or of any subset of it with the other rows zero.
    """

    name: str
    schur: NDArray[np.float64]

    def forward(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Eliminate everything but the retained rows, (n, k) -> (n, k)."""
        ...

    def backward(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Recover the eliminated rows from the retained ones, (n, k) -> (n, k)."""
        ...


class SuperLU:
    """SciPy's own direct solver: available everywhere, slow and memory-hungry on tetrahedra (no nested dissection)."""

    name = "scipy"

    def __init__(self, matrix: sp.csr_matrix) -> None:
        try:
            self._lu = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:
            raise ArithmeticError(f"SuperLU: {error}") from error

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides (n, k)."""
        return self._lu.solve(np.asarray(rhs, dtype=np.float64))


class SuperLUCondensation:
    """The Schur complement by as many solves as there are retained dofs."""

    name = "scipy"

    def __init__(self, matrix: sp.csr_matrix, retained: NDArray[np.bool_]) -> None:
        self._inner, self._retained = np.flatnonzero(~retained), np.flatnonzero(retained)
        self._lu = SuperLU(matrix[self._inner][:, self._inner])
        self._coupling = matrix[self._inner][:, self._retained].tocsc()
        self.schur = matrix[self._retained][:, self._retained].toarray()
        for start in range(0, len(self._retained), BLOCK):
            block = self._coupling[:, start : start + BLOCK].toarray()
            self.schur[:, start : start + BLOCK] -= self._coupling.T @ self._lu.solve(block)

    def forward(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inner rows become A_II^-1 f_I, retained rows the condensed right-hand side."""
        result = np.empty_like(rhs)
        result[self._inner] = self._lu.solve(rhs[self._inner])
        result[self._retained] = rhs[self._retained] - self._coupling.T @ result[self._inner]
        return result

    def backward(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inner rows become A_II^-1 (f_I - A_IV u_V)."""
        result = rhs.copy()
        result[self._inner] -= self._lu.solve(self._coupling @ rhs[self._retained])
        return result


class PardisoCondensation(Pardiso):
    """MKL PARDISO's Schur complement, which falls off the factorisation."""

    schur: NDArray[np.float64]


def resolve(solver: SolverName) -> Literal["pardiso", "scipy"]:
    """Which solver a name stands for on this machine: `auto` is PARDISO where MKL can be loaded, else SciPy.

    Raises
    ------
    InputError
        The name is unknown, or PARDISO was asked for and MKL cannot be loaded.
    """
    if solver not in ("auto", "pardiso", "scipy"):
        raise InputError("solver", f"unknown solver {solver!r}", "choose auto, pardiso or scipy")
    if solver == "scipy":
        return "scipy"
    try:
        load_mkl()
    except OSError as error:
        if solver == "pardiso":
            raise InputError("solver", f"MKL cannot be loaded ({error})", "install the mkl wheel, or choose scipy") from error
        return "scipy"
    return "pardiso"


def factorize(matrix: sp.csr_matrix, solver: SolverName = "auto") -> Factorization:
    """Factorise a sparse SPD matrix."""
    return Pardiso(matrix) if resolve(solver) == "pardiso" else SuperLU(matrix)


def condense(matrix: sp.csr_matrix, retained: NDArray[np.bool_], solver: SolverName = "auto") -> Condensation:
    """Factorise a sparse SPD matrix up to the Schur complement on the retained dofs (mask, at least one)."""
    if resolve(solver) == "pardiso":
        return PardisoCondensation(matrix, retained)
    return SuperLUCondensation(matrix, retained)


def relative_residual(
    matrix: sp.csr_matrix,
    solution: NDArray[np.float64],
    rhs: NDArray[np.float64],
    equations: NDArray[np.bool_] | None = None,
) -> float:
    """Largest ||A x - b|| / ||b|| over the columns (n, k); a zero column counts absolutely.

    `equations`, (n, k), marks the rows that count; without it all do.
    """
    counted = np.ones(rhs.shape, dtype=bool) if equations is None else equations
    residual = np.linalg.norm((matrix @ solution - rhs) * counted, axis=0)
    norm = np.linalg.norm(rhs * counted, axis=0)
    return float(np.max(residual / np.where(norm > 0.0, norm, 1.0), initial=0.0))


def assert_residual(residual: float, solver: str) -> None:
    """Refuse a solution whose residual says that it is none.

    Raises
    ------
    ArithmeticError
        The residual is above :data:`RESIDUAL_LIMIT` or not a number.
    """
    if not residual <= RESIDUAL_LIMIT:
        raise ArithmeticError(f"{solver}: relative residual {residual:.2g} is above {RESIDUAL_LIMIT:.0e}: no solution")

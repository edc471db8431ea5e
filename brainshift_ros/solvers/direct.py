"""Direct solvers for symmetric sparse systems, chosen by name.

Positive definite ones, of elasticity and steady pressure, and quasi-definite ones, ``[[A, B], [B^T, -C]]`` with A and C
positive definite, of consolidation. Those too factorise in any order (Vanderbei, SIAM J. Optim. 5, 1995), the worse the
smaller C is; give them with rows of like size (:func:`equilibration`).
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from brainshift_ros.errors import InputError
from brainshift_ros.solvers.pardiso import Pardiso, load_mkl

SolverName = Literal["auto", "pardiso", "scipy"]

#: Right-hand sides that are solved together: enough to fill the processor, few enough to stay small in memory.
BLOCK = 128

#: SuperLU leaves a diagonal pivot of an indefinite matrix that is smaller than this share of its column.
INDEFINITE_PIVOT = 0.01

#: Largest relative residual of a solution that is passed on.
RESIDUAL_LIMIT = 1e-8


class Factorization(Protocol):
    """A factorised matrix: `solve` takes and gives (n, k)."""

    name: str

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for k right-hand sides."""
        ...


class Condensation(Protocol):
    """A matrix factorised up to its Schur complement on some retained dofs (static condensation).

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

    def __init__(self, matrix: sp.csr_matrix, *, definite: bool = True) -> None:
        threshold = 0.0 if definite else INDEFINITE_PIVOT
        options = {"SymmetricMode": True}
        try:
            self._lu = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=threshold, options=options)
        except RuntimeError as error:
            raise ArithmeticError(f"SuperLU: {error}: something must hold the body against rigid motion") from error

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides (n, k)."""
        return self._lu.solve(np.asarray(rhs, dtype=np.float64))


class SuperLUCondensation:
    """The Schur complement by as many solves as there are retained dofs."""

    name = "scipy"

    def __init__(self, matrix: sp.csr_matrix, retained: NDArray[np.bool_], *, definite: bool = True) -> None:
        self._inner, self._retained = np.flatnonzero(~retained), np.flatnonzero(retained)
        self._lu = SuperLU(matrix[self._inner][:, self._inner], definite=definite)
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


class NothingEliminated:
    """All dofs are retained, so that the Schur complement is the matrix itself; PARDISO leaves it undefined then."""

    name = "dense"

    def __init__(self, matrix: sp.csr_matrix) -> None:
        self.schur = matrix.toarray()

    def forward(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Nothing is to be eliminated."""
        return rhs.copy()

    def backward(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Nothing is to be recovered."""
        return rhs.copy()


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


def factorize(matrix: sp.csr_matrix, solver: SolverName = "auto", *, definite: bool = True) -> Factorization:
    """Factorise a sparse symmetric matrix, positive or quasi-definite."""
    return Pardiso(matrix, definite=definite) if resolve(solver) == "pardiso" else SuperLU(matrix, definite=definite)


def condense(
    matrix: sp.csr_matrix, retained: NDArray[np.bool_], solver: SolverName = "auto", *, definite: bool = True
) -> Condensation:
    """Factorise a sparse symmetric matrix up to the Schur complement on the retained dofs (mask, at least one)."""
    if retained.all():
        return NothingEliminated(matrix)
    if resolve(solver) == "pardiso":
        return PardisoCondensation(matrix, retained, definite=definite)
    return SuperLUCondensation(matrix, retained, definite=definite)


def equilibration(matrix: sp.csr_matrix, steps: int = 8) -> NDArray[np.float64]:
    """Weights d (n,) for which all rows of ``diag(d) A diag(d)`` have a largest entry of about one (Ruiz, RAL-TR-2001-034)."""
    weight = np.ones(matrix.shape[0])
    magnitude = abs(matrix).tocsr()
    for _ in range(steps):
        largest = (sp.diags(weight) @ magnitude @ sp.diags(weight)).max(axis=1).toarray().ravel()
        weight /= np.sqrt(np.where(largest > 0.0, largest, 1.0))
    return weight


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
        problem = f"relative residual {residual:.2g} is above {RESIDUAL_LIMIT:.0e}: no solution"
        raise ArithmeticError(f"{solver}: {problem}: is the body held against rigid motion, and is every element sound?")

"""One-sided contact on a few condensed dofs: an exact linear complementarity problem (LCP).

Tissue may leave the skull but not cross it. With x the displacement along the outward normals, S the condensed stiffness
and g the condensed load,

    x <= 0,    r = S x - g <= 0,    x r = 0,

where r is what the skull does to the tissue. For a positive definite S it has exactly one solution: the minimum of
1/2 x^T S x - g^T x over x <= 0. It is found by block principal pivoting (Portugal, Judice, Vicente, Math. Comp. 63, 1994): all
dofs of wrong sign change sides at once, which is the primal-dual active set method or semi-smooth Newton (Hintermueller,
Ito, Kunisch, SIAM J. Optim. 13, 2002) and takes a few steps; if their number has not gone down for a while, one at a time
(Murty), which ends always. The result is exact to round-off, not an approximation by penalty or regularisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.solvers.dense import Cholesky

#: A sign is wrong if it is so by more than this share of the largest displacement or force: less is round-off.
TOLERANCE = 1e-12

#: Exchanges of all wrong dofs at once that may fail to lower their number before single ones are tried.
PATIENCE = 10


def most_iterations(count: int) -> int:
    """Far more iterations than contact of so many dofs ever took: beyond it something is wrong."""
    return 100 + 10 * count


class BlockPivoting:
    """Which of the dofs of wrong sign change sides next."""

    def __init__(self) -> None:
        self._fewest: float = np.inf
        self._patience = PATIENCE

    def exchange(self, wrong: NDArray[np.int64]) -> NDArray[np.int64]:
        """All of them while their number goes down now and then, else only the last."""
        if len(wrong) < self._fewest:
            self._fewest, self._patience = len(wrong), PATIENCE
        else:
            self._patience -= 1
        return wrong if self._patience >= 0 else wrong[-1:]


@dataclass(frozen=True)
class ContactState:
    """Solution of one contact problem of m dofs.

    Attributes
    ----------
    displacement
        Shape (m,), not positive, exactly zero where closed.
    closed
        Shape (m,), where the tissue touches the skull.
    iterations
        How many sets of closed dofs were tried.
    """

    displacement: NDArray[np.float64]
    closed: NDArray[np.bool_]
    iterations: int


class ContactProblem:
    """The contact problem of one condensed stiffness, for any number of loads.

    Each set of closed dofs is solved where it is smaller: with few closed by the compliance S^-1 for their forces, with few
    open by S for their displacements.

    Parameters
    ----------
    stiffness
        Shape (m, m), SPD.

    Raises
    ------
    ArithmeticError
        The stiffness is not positive definite.
    """

    def __init__(self, stiffness: NDArray[np.float64]) -> None:
        self._stiffness = stiffness
        self._compliance = Cholesky(stiffness.copy(order="F")).inverse()
        self._largest_stiffness = float(np.abs(stiffness).max(initial=0.0))

    def solve(self, load: NDArray[np.float64], guess: NDArray[np.bool_]) -> ContactState:
        """Solve for one load.

        Parameters
        ----------
        load
            Shape (m,), g.
        guess
            Shape (m,), which dofs are closed, to start from; it decides the time, not the solution.

        Raises
        ------
        ArithmeticError
            No end was found, which round-off could cause only in a matrix that is hardly positive definite.
        """
        unhindered = self._compliance @ load
        reach = float(np.abs(unhindered).max(initial=0.0))
        crossing = TOLERANCE * reach
        pulling = TOLERANCE * max(float(np.abs(load).max(initial=0.0)), self._largest_stiffness * reach)
        closed, pivoting = guess.copy(), BlockPivoting()
        for iteration in range(1, most_iterations(len(load))):
            displacement, force = self._under(closed, load, unhindered)
            wrong = np.flatnonzero(np.where(closed, force < -pulling, displacement > crossing))
            if len(wrong) == 0:
                return ContactState(displacement, closed, iteration)
            closed[pivoting.exchange(wrong)] ^= True
        raise ArithmeticError("contact: no set of closed dofs was found: is every element sound?")

    def _under(
        self, closed: NDArray[np.bool_], load: NDArray[np.float64], unhindered: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Displacement and force of the tissue on the skull, ``g - S x``, if just these dofs are closed."""
        touching, free = np.flatnonzero(closed), np.flatnonzero(~closed)
        force = np.zeros_like(load)
        if len(touching) <= len(free):
            displacement = unhindered.copy()
            if len(touching):
                force[touching] = _solve(self._compliance, touching, unhindered[touching])
                displacement -= self._compliance[:, touching] @ force[touching]
                displacement[touching] = 0.0
        else:
            displacement = np.zeros_like(load)
            if len(free):
                displacement[free] = _solve(self._stiffness, free, load[free])
            force[touching] = (load - self._stiffness[:, free] @ displacement[free])[touching]
        return displacement, force


def _solve(matrix: NDArray[np.float64], chosen: NDArray[np.int64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
    return Cholesky(matrix[np.ix_(chosen, chosen)].T).solve(rhs)

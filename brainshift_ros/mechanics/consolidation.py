"""Biphasic consolidation in time: (3.1) and (3.2) by backward Euler, both equations solved at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.solvers.many import ManySolver


@dataclass(frozen=True)
class TimeSteps:
    """Equal steps: `count` of `dt_s` seconds."""

    count: int
    dt_s: float

    @property
    def duration_s(self) -> float:
        """Their sum."""
        return self.count * self.dt_s

    def number_at(self, time_s: float) -> int:
        """How many steps end nearest to a time, at least one."""
        return int(np.clip(round(time_s / self.dt_s), 1, self.count))


def time_steps(duration_s: float, dt_s: float) -> TimeSteps:
    """Divide a duration into equal steps, none longer than asked.

    Where `dt_s` does not divide the duration, all steps are a little shorter, so that one factorisation still serves all.

    Raises
    ------
    InputError
        One of them is not finite or not positive, or the step is longer than the duration.
    """
    for name, value in (("duration_s", duration_s), ("dt_s", dt_s)):
        if not (np.isfinite(value) and value > 0.0):
            raise InputError("time", f"{name} is {value}", "give seconds, above zero")
    if dt_s > duration_s * (1.0 + 1e-9):
        raise InputError(
            "time", f"the step of {dt_s:g} s is longer than the duration of {duration_s:g} s", "give a shorter dt_s"
        )
    count = max(1, int(np.ceil(duration_s / dt_s * (1.0 - 1e-9))))
    return TimeSteps(count, duration_s / count)


class BackwardEuler:
    r"""One time step of the coupled equations, implicit in both: unconditionally stable, first order in dt.

    With K the stiffness, Q the coupling, S the storage and F the conductance with k_c, a step solves

    .. math::
        K u - Q p = f, \qquad Q^T (u - u_0) + S (p - p_0) + dt\,(F p - s) = 0

    as one symmetric quasi-definite system. Its pressures are in a unit that gives both blocks diagonals of one size: without
    it the residual of one equation would drown in that of the other. Splitting the two equations and iterating between
    them ("fixed stress") does not converge where 1/S = 0 and the tissue is confined.

    Parameters
    ----------
    stiffness, coupling
        Sparse (3n, 3n) and (3n, N), in the same components of the displacement.
    storage
        Sparse (N, N): lumped 1/S, and the stabilisation.
    flow
        Sparse (N, N): :meth:`~brainshift_ros.mechanics.fluid.Fluid.helmholtz`.
    dt_s
        Length of the step, s.

    Attributes
    ----------
    matrix
        Sparse (3n + N, 3n + N), displacements before pressures.
    dt_s
        As given.
    """

    def __init__(
        self, stiffness: sp.csr_matrix, coupling: sp.csr_matrix, storage: sp.csr_matrix, flow: sp.csr_matrix, dt_s: float
    ) -> None:
        self._coupling, self._storage, self.dt_s = coupling, storage, dt_s
        content = storage + dt_s * flow
        self._unit = float(np.sqrt(stiffness.diagonal().mean() / content.diagonal().mean()))
        scaled = self._unit * coupling
        self.matrix = sp.block_array([[stiffness, -scaled], [-scaled.T, -(self._unit**2) * content]], format="csr")

    def right_side(
        self,
        force: NDArray[np.float64],
        source: NDArray[np.float64],
        displacement: NDArray[np.float64],
        pressure: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Right-hand sides (3n + N, k) from forces (3n, k), sources (N, k), and the state at the beginning of the step."""
        content = self._coupling.T @ displacement + self._storage @ pressure + self.dt_s * source
        return np.concatenate([force, -self._unit * content])

    def split(self, solution: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Displacements (3n, k) in m and pressures (N, k) in Pa of solutions (3n + N, k)."""
        count = self._coupling.shape[0]
        return solution[:count], self._unit * solution[count:]


@dataclass(frozen=True)
class State:
    """Displacement and pressure of k cases at the end of a time step.

    Attributes
    ----------
    step, time_s
        Number of the step, from 1, and the time since the load began.
    displacement
        Shape (3n, k), m, in the components of the stiffness.
    pressure
        Shape (N, k), Pa.
    residual
        Largest relative residual of the steps so far.
    closed
        Shape (3n, k), normals on which the skull presses; None without contact.
    iterations
        Shape (k,), most sets of closed normals that a step so far had to try.
    """

    step: int
    time_s: float
    displacement: NDArray[np.float64]
    pressure: NDArray[np.float64]
    residual: float
    closed: NDArray[np.bool_] | None
    iterations: NDArray[np.int64]


def march(
    step: BackwardEuler,
    solver: ManySolver,
    set_of_column: ArrayLike,
    force: NDArray[np.float64],
    source: NDArray[np.float64],
    count: int,
) -> Iterator[State]:
    """Follow k cases from rest, u = p = 0, under loads and sources that act from t = 0+ on.

    The first step so holds the undrained response to the load and what drains within dt.

    Parameters
    ----------
    step, solver
        The step's equations, and a solver of its matrix.
    set_of_column
        Shape (k,), constraint set of each case in the solver.
    force, source
        Shapes (3n, k), N, and (N, k), m^3/s.
    count
        Number of steps.

    Raises
    ------
    ArithmeticError
        The residual of a step is too large.
    """
    displacement, pressure = np.zeros_like(force), np.zeros_like(source)
    closed, guess, worst = None, None, 0.0
    iterations = np.zeros(force.shape[1], dtype=np.int64)
    for number in range(1, count + 1):
        block = solver.solve_block(step.right_side(force, source, displacement, pressure), set_of_column, guess)
        displacement, pressure = step.split(block.solution)
        worst, iterations = max(worst, block.residual), np.maximum(iterations, block.iterations)
        if block.closed is not None:
            guess, closed = block.closed, block.closed[: len(force)]
        yield State(number, number * step.dt_s, displacement, pressure, worst, closed, iterations)

"""Solutions of (3.1) and (3.2) some time after a mechanism began to act: many cases, marched together."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.batches import batches
from brainshift_ros.mechanics.boundary import CAP_LEVEL
from brainshift_ros.mechanics.cases import Capillaries, Case
from brainshift_ros.mechanics.consolidation import BackwardEuler, State, TimeSteps, march, time_steps
from brainshift_ros.mechanics.skull import SkullName, skull_constraints
from brainshift_ros.mechanics.stabilization import stabilization
from brainshift_ros.mechanics.steady import Direction, SolvedBlock
from brainshift_ros.mechanics.system import System
from brainshift_ros.solvers.direct import SolverName, resolve
from brainshift_ros.solvers.many import ManySolver

#: What the dense factors of one batch of constraint sets may fill: they are kept from the first time step to the last.
DENSE_BYTES = 6e8

Progress = Callable[[str, float], None]

#: Number of a direction, and the fluid level where that decides what drains.
ConstraintKey = tuple[int, float | None]


@dataclass(frozen=True)
class History:
    """Solutions of k cases at some times.

    Attributes
    ----------
    times_s
        Shape (t,), ends of time steps.
    displacement
        Shape (t, N, 3, k), m, patient frame, at every node of the head.
    pressure
        Shape (t, n, k), Pa, at the vertices of the derived mesh.
    residual
        Largest relative residual of all steps.
    """

    times_s: NDArray[np.float64]
    displacement: NDArray[np.float64]
    pressure: NDArray[np.float64]
    residual: float


class TransientModel:
    """Solutions at the end of a duration, from a head at rest, by the interface of `SteadyModel`.

    Where it drains depends on the mechanism: gravity's fluid has left the surface above the fluid level, so p = 0 there; the
    others drain through the stress-free surface. Capillaries take part in all of them: gravity's at p_c = 0 and k_c1.

    Cases with one capillary permeability share a matrix. Cases whose constraints resemble each other are marched
    together: one sparse factorisation with a dense Schur complement on the dofs whose status differs among them.

    Parameters
    ----------
    system
        The elements.
    directions
        Directions of gravity of all cases that may be asked.
    duration_s, dt_s
        When the solution is wanted, and the longest time step; see
        :func:`~brainshift_ros.mechanics.consolidation.time_steps`.
    skull, opening, cap_level, solver
        As for :class:`~brainshift_ros.mechanics.steady.SteadyModel`. Contact holds at each step.
    dense_bytes
        What the dense factors of cases that are marched together may fill.

    Attributes
    ----------
    name
        The linear solver that is used.
    variable_normals
        Number of skull normals that are not of one status for all directions.
    steps
        The time steps.

    Raises
    ------
    InputError
        The times are no times.
    """

    def __init__(
        self,
        system: System,
        directions: Sequence[Direction],
        *,
        duration_s: float,
        dt_s: float,
        skull: SkullName = "free_cap",
        opening: NDArray[np.bool_] | None = None,
        cap_level: float = CAP_LEVEL,
        solver: SolverName = "auto",
        dense_bytes: float = DENSE_BYTES,
    ) -> None:
        self.steps: TimeSteps = time_steps(duration_s, dt_s)
        self.name = resolve(solver)
        self._system, self._cap_level, self._solver, self._dense_bytes = system, cap_level, solver, dense_bytes
        self._directions = tuple(dict.fromkeys(directions))
        self._number_of = {direction: number for number, direction in enumerate(self._directions)}
        self._masks: dict[ConstraintKey, tuple[NDArray[np.bool_], NDArray[np.bool_]]] = {}
        self._held, self._one_sided = skull_constraints(system, self._directions, skull, opening, cap_level)
        some = self._held if self._one_sided is None else self._held | self._one_sided
        self.variable_normals = int((some.any(axis=0) & ~self._held.all(axis=0)).sum())
        self._capillaries = Capillaries(system)
        fluid = system.fluid
        self._coupling = (system.rotation @ fluid.coupling).tocsr()
        self._storage = (stabilization(fluid) + sp.diags_array(fluid.lumped(system.material.storage))).tocsr()

    def solve(self, cases: Sequence[Case], progress: Progress | None = None) -> Iterator[SolvedBlock]:
        """Solve cases in blocks of those that are marched together.

        Parameters
        ----------
        cases
            Their directions are among the model's.
        progress
            Called after each time step with the stage ``solve`` and the fraction that is done.

        Raises
        ------
        InputError
            A case has another direction, or asks for swelling in a head without a tumour.
        ArithmeticError
            A residual is too large.
        """
        done = 0
        for batch in self._batches(cases):
            last = deque(self._states(cases, batch, _reporter(progress, done, len(batch), len(cases))), maxlen=1).pop()
            closed = np.zeros(len(batch), dtype=np.int64) if last.closed is None else last.closed.sum(axis=0)
            yield SolvedBlock(
                cases=batch,
                displacement=self._system.displacement(last.displacement),
                residual=last.residual,
                contact_iterations=last.iterations,
                closed_normals=closed,
            )
            done += len(batch)

    def history(self, cases: Sequence[Case], times_s: Sequence[float], progress: Progress | None = None) -> History:
        """Solutions at the ends of the steps nearest to some times, in ascending order, and how they came about.

        Raises
        ------
        InputError, ArithmeticError
            As :meth:`solve`.
        """
        numbers = sorted({self.steps.number_at(time_s) for time_s in times_s})
        displacement = np.empty((len(numbers), len(self._system.head.nodes), 3, len(cases)))
        pressure = np.empty((len(numbers), len(self._system.fluid), len(cases)))
        worst, done = 0.0, 0
        for batch in self._batches(cases):
            for state in self._states(cases, batch, _reporter(progress, done, len(batch), len(cases))):
                if state.step in numbers:
                    place = numbers.index(state.step)
                    displacement[place][:, :, batch] = self._system.displacement(state.displacement)
                    pressure[place][:, batch] = state.pressure
                worst = max(worst, state.residual)
            done += len(batch)
        return History(np.array(numbers) * self.steps.dt_s, displacement, pressure, worst)

    def _batches(self, cases: Sequence[Case]) -> Iterator[list[int]]:
        fractions, sets = [case.exchange_fraction for case in cases], [self._set_of(case) for case in cases]
        return batches(fractions, sets, self._constraints, self._dense_bytes)

    def _states(self, cases: Sequence[Case], batch: list[int], report: Callable[[float], None]) -> Iterator[State]:
        """March a batch, whose cases have one capillary permeability."""
        chosen = [cases[number] for number in batch]
        system, fluid, capillaries = self._system, self._system.fluid, self._capillaries
        exchange = capillaries.exchange(chosen[0])
        step = BackwardEuler(system.stiffness, self._coupling, self._storage, fluid.helmholtz(exchange), self.steps.dt_s)
        sets = list(dict.fromkeys(self._set_of(case) for case in chosen))
        held, one_sided = (np.array(masks) for masks in zip(*(self._constraints(key) for key in sets), strict=True))
        contact = None if self._one_sided is None else one_sided
        solver = ManySolver(step.matrix, held, contact, self._solver, definite=False)
        force = np.zeros((system.stiffness.shape[0], len(chosen)))
        for column, case in enumerate(chosen):
            if case.mechanism == "gravity":
                force[:, column] = system.gravity(case.gravity_direction, case.fluid_level)
        source = np.stack([fluid.source(exchange, capillaries.pressure(case)) for case in chosen], axis=1)
        set_of_column = [sets.index(self._set_of(case)) for case in chosen]
        for state in march(step, solver, set_of_column, force, source, self.steps.count):
            report(state.step / self.steps.count)
            yield state

    def _set_of(self, case: Case) -> ConstraintKey:
        if case.gravity_direction not in self._number_of:
            problem = f"its gravity direction {case.gravity_direction} is none of the model's"
            raise InputError("case", problem, "make the model with it")
        level = case.fluid_level if case.mechanism == "gravity" else None
        return self._number_of[case.gravity_direction], level

    def _constraints(self, key: ConstraintKey) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Held and one-sided dofs (3n + N,), displacements before pressures."""
        if key not in self._masks:
            number, level = key
            direction = self._directions[number]
            if level is None:
                drained = self._system.stress_free(direction, self._cap_level)
            else:
                drained = self._system.drained(direction, level)
            pushed = np.zeros_like(self._held[number]) if self._one_sided is None else self._one_sided[number]
            self._masks[key] = np.append(self._held[number], drained), np.append(pushed, np.zeros_like(drained))
        return self._masks[key]


def _reporter(progress: Progress | None, done: int, batch: int, cases: int) -> Callable[[float], None]:
    """Progress of one batch as a part of all cases'."""

    def report(fraction: float) -> None:
        if progress is not None:
            progress("solve", (done + batch * fraction) / cases)

    return report

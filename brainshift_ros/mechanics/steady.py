"""Steady solutions of (3.1) and (3.2): pressure first, where any acts, then displacement with its gradient as load."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.boundary import CAP_LEVEL
from brainshift_ros.mechanics.cases import Capillaries, Case
from brainshift_ros.mechanics.skull import SkullName, skull_constraints
from brainshift_ros.mechanics.system import System
from brainshift_ros.solvers.direct import BLOCK, SolverName
from brainshift_ros.solvers.many import ManySolver

Direction = tuple[float, float, float]


@dataclass(frozen=True)
class SolvedBlock:
    """Solutions of some cases.

    Attributes
    ----------
    cases
        Their numbers, k of them.
    displacement
        Shape (N, 3, k), m, patient frame, at every node of the head.
    residual
        Largest relative residual of the block's linear systems.
    contact_iterations
        Shape (k,), sets of closed normals that were tried; zero without contact.
    closed_normals
        Shape (k,), number of one-sided skull normals that press against the skull.
    """

    cases: list[int]
    displacement: NDArray[np.float64]
    residual: float
    contact_iterations: NDArray[np.int64]
    closed_normals: NDArray[np.int64]


class SteadyModel:
    """All steady solutions on one set of elements.

    Gravity's pressure vanishes in the steady state, so it is elasticity alone. The others solve (3.2) without its time
    derivatives, a Helmholtz problem whose matrix depends on the drug's level only. Its solvers are made when a case first
    needs them: none for an atlas of gravity.

    Parameters
    ----------
    system
        The elements.
    directions
        Directions of gravity of all cases that may be asked.
    skull
        ``free_cap`` or ``contact``; see :func:`~brainshift_ros.mechanics.skull.skull_constraints`.
    opening
        Shape (N,), nodes of the head under the craniotomy, for ``contact``.
    cap_level
        Demarcation of the stress-free cap.
    solver
        ``auto``, ``pardiso`` or ``scipy``.

    Attributes
    ----------
    name
        The linear solver that is used.
    variable_normals
        Number of skull normals that are not of one status for all directions.

    Raises
    ------
    ArithmeticError
        The stiffness matrix cannot be factorised.
    """

    def __init__(
        self,
        system: System,
        directions: Sequence[Direction],
        *,
        skull: SkullName = "free_cap",
        opening: NDArray[np.bool_] | None = None,
        cap_level: float = CAP_LEVEL,
        solver: SolverName = "auto",
    ) -> None:
        self._system, self._cap_level, self._solver = system, cap_level, solver
        self._directions: tuple[Direction, ...] = tuple(dict.fromkeys(directions))
        self._set_of = {direction: number for number, direction in enumerate(self._directions)}
        held, one_sided = skull_constraints(system, self._directions, skull, opening, cap_level)
        self._displacement = ManySolver(system.stiffness, held, one_sided, solver)
        self.name, self.variable_normals = self._displacement.name, self._displacement.variable_count
        self._capillaries = Capillaries(system)
        self._pressure: dict[float, ManySolver] = {}
        self._sources: dict[tuple[str, float], NDArray[np.float64]] = {}

    def solve(self, cases: Sequence[Case], progress: Callable[[str, float], None] | None = None) -> Iterator[SolvedBlock]:
        """Solve cases in blocks: gravity first, then by direction.

        Parameters
        ----------
        cases
            Their directions are among the model's.
        progress
            Called after each block with the stage ``solve`` and the fraction that is done.

        Raises
        ------
        InputError
            A case has another direction, or asks for swelling in a head without a tumour.
        ArithmeticError
            A residual is too large.
        """
        sets = np.array([self._set_number(case) for case in cases], dtype=np.int64)
        # Of one kind of load, a block needs no sorting into columns; of one direction, it shares its dense factor.
        order = np.lexsort((sets, np.array([case.mechanism != "gravity" for case in cases])))
        for start in range(0, len(cases), BLOCK):
            numbers = order[start : start + BLOCK].tolist()
            loads, pressure_residual = self._loads([cases[number] for number in numbers], sets[numbers])
            solved = self._displacement.solve_block(loads, sets[numbers])
            closed = np.zeros(len(numbers), dtype=np.int64) if solved.closed is None else solved.closed.sum(axis=0)
            yield SolvedBlock(
                cases=numbers,
                displacement=self._system.displacement(solved.solution),
                residual=max(solved.residual, pressure_residual),
                contact_iterations=solved.iterations,
                closed_normals=closed,
            )
            if progress is not None:
                progress("solve", (start + len(numbers)) / len(cases))

    def pressure(self, cases: Sequence[Case]) -> NDArray[np.float64]:
        """Steady pressure of some cases, shape (n, k), Pa, at the vertices of the derived mesh."""
        sets = np.array([self._set_number(case) for case in cases], dtype=np.int64)
        return self._pressures(cases, sets)[0]

    def _set_number(self, case: Case) -> int:
        try:
            return self._set_of[case.gravity_direction]
        except KeyError:
            problem = f"its gravity direction {case.gravity_direction} is none of the model's"
            raise InputError("case", problem, "make the model with it") from None

    def _loads(self, cases: Sequence[Case], sets: NDArray[np.int64]) -> tuple[NDArray[np.float64], float]:
        """Find the loads (3n, k), gravity's first, and the largest residual of the pressures behind the others."""
        split = sum(case.mechanism == "gravity" for case in cases)
        parts, residual = [], 0.0
        if split > 0:
            directions, levels = zip(*((case.gravity_direction, case.fluid_level) for case in cases[:split]), strict=True)
            parts.append(self._system.gravity_loads(directions, levels))
        if split < len(cases):
            pressure, residual = self._pressures(cases[split:], sets[split:])
            parts.append(self._system.pressure_load(pressure))
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1), residual

    def _pressures(self, cases: Sequence[Case], sets: NDArray[np.int64]) -> tuple[NDArray[np.float64], float]:
        pressure, largest = np.empty((self._system.space.vertex_count, len(cases))), 0.0
        fractions = np.array([case.exchange_fraction for case in cases])
        for fraction in np.unique(fractions):
            columns = np.flatnonzero(fractions == fraction)
            chosen = [cases[column] for column in columns.tolist()]
            sources = np.stack([self._source(case) for case in chosen], axis=1)
            block = self._pressure_solver(chosen[0]).solve_block(sources, sets[columns])
            pressure[:, columns], largest = block.solution, max(largest, block.residual)
        return pressure, largest

    def _source(self, case: Case) -> NDArray[np.float64]:
        """Fluid that the capillaries would give at p = 0, (n,), m^3/s: the same however the head lies."""
        kind = (case.mechanism, case.intensity)
        if kind not in self._sources:
            capillaries = self._capillaries
            self._sources[kind] = self._system.fluid.source(capillaries.exchange(case), capillaries.pressure(case))
        return self._sources[kind]

    def _pressure_solver(self, case: Case) -> ManySolver:
        fraction = case.exchange_fraction
        if fraction not in self._pressure:
            drained = np.array([self._system.stress_free(direction, self._cap_level) for direction in self._directions])
            matrix = self._system.fluid.helmholtz(self._capillaries.exchange(case))
            self._pressure[fraction] = ManySolver(matrix, drained, None, self._solver)
        return self._pressure[fraction]

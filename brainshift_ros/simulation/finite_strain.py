"""Sag of a finite-strain brain in a rigid skull: a truth that does not share the atlas's small-strain theory.

A compressible neo-Hookean solid (:mod:`neo_hookean`) on the element set of a linear :class:`System`, total Lagrangian. The
brainstem is fixed; septa and, below the cap, the skull are slip surfaces with the normals at rest; in the cap tissue may
leave the skull but not cross it (true distance, :mod:`skull_gap`), and in the craniotomy's opening it is free. Gravity and
buoyancy are dead loads of the shape at rest, as in the linear theory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.boundary import CAP_LEVEL
from brainshift_ros.mechanics.system import System
from brainshift_ros.simulation.contact_newton import (
    NewtonStep,
    NoEquilibriumError,
    Supports,
    Wall,
    at_rest,
    equilibrium,
)
from brainshift_ros.simulation.hyperelastic import HyperelasticBody
from brainshift_ros.simulation.skull_gap import SkullGap
from brainshift_ros.solvers.direct import SolverName, resolve
from brainshift_ros.surface.surface import Surface

Progress = Callable[[str, float], None]

#: A load step is halved at most this often before the load is declared too large.
_HALVINGS = 5


@dataclass(frozen=True)
class FiniteStrainSolution:
    """A finite-strain equilibrium and how it was reached.

    Attributes
    ----------
    displacement
        Shape (N, 3), m, patient frame, at every node of the head's mesh; harmonic extension where resection left no tissue.
    contact_force
        Shape (k,), N, at the one-sided nodes, pushing inward.
    gap
        Shape (k,), m: how far they left the skull, >= 0.
    history
        Every Newton iteration.
    smallest_jacobian
        Smallest det F at the quadrature points.
    solver
        Name of the linear solver that was used.
    warnings
        What a person should know before trusting the solution.
    """

    displacement: NDArray[np.float64]
    contact_force: NDArray[np.float64]
    gap: NDArray[np.float64]
    history: tuple[NewtonStep, ...]
    smallest_jacobian: float
    solver: str
    warnings: tuple[str, ...]


def solve_finite_strain(
    system: System,
    gravity_direction: ArrayLike,
    fluid_level: float,
    *,
    cap_level: float = CAP_LEVEL,
    opening: NDArray[np.bool_] | None = None,
    growth: NDArray[np.float64] | None = None,
    load_steps: int = 2,
    solver: SolverName = "auto",
    progress: Progress | None = None,
) -> FiniteStrainSolution:
    """Solve for the equilibrium under gravity and, if given, a drug's contraction.

    Parameters
    ----------
    system
        The element set, linear or quadratic, with or without the tumour.
    gravity_direction, fluid_level, cap_level
        As in :func:`brainshift_ros.mechanics.forward.solve_gravity`.
    opening
        Shape (N,), outer nodes of the head in the craniotomy's opening; None leaves the skull closed.
    growth
        Shape (M of the head,), ratio of each element's stress-free volume to that at rest: below one where a drug shrinks it.
    load_steps
        In how many steps load and growth are applied at first; a step that finds no equilibrium is halved.
    solver
        ``auto``, ``pardiso`` or ``scipy``.
    progress
        Called with stage and fraction of the load.

    Raises
    ------
    InputError
        `growth` does not fit the mesh or is not positive.
    NoEquilibriumError
        Not even small load steps find an equilibrium.
    """
    grown = _checked_growth(system, growth)
    supports = _supports(system, gravity_direction, cap_level, opening)
    load = (system.rotation.T @ system.gravity(gravity_direction, fluid_level)).reshape(-1, 3)
    state = at_rest(len(load), supports.wall)
    basis = system.space.basis
    history: list[NewtonStep] = []
    reached, step = 0.0, 1.0 / load_steps
    while reached < 1.0:
        fraction = min(1.0, reached + step)
        body = HyperelasticBody(basis, system.material, grown**fraction)
        try:
            state, steps = equilibrium(body, fraction * load, supports, state, fraction=fraction, solver=solver)
        except NoEquilibriumError:
            step /= 2.0
            if step * load_steps < 0.5**_HALVINGS:
                raise
            continue
        history += steps
        reached = fraction
        if progress is not None:
            progress("finite strain", reached)
    local = system.rotation @ state.u.ravel()
    gap, _ = supports.wall.gap(state.u[supports.wall.nodes])
    return FiniteStrainSolution(
        displacement=system.displacement(local[:, None])[:, :, 0],
        contact_force=state.force,
        gap=-gap,
        history=tuple(history),
        smallest_jacobian=history[-1].smallest_jacobian,
        solver=resolve(solver),
        warnings=system.warnings,
    )


def _supports(system: System, gravity_direction: ArrayLike, cap_level: float, opening: NDArray[np.bool_] | None) -> Supports:
    """Take what holds the body from the linear model; only the wall is curved."""
    held, one_sided = system.held_and_one_sided(gravity_direction, cap_level, opening)
    nodes, axis = np.nonzero(one_sided.reshape(-1, 3))
    frames = system.boundary.frames
    skull = Surface(system.head.nodes, system.head.facets["skull"])
    gap = SkullGap(skull, system.space.points[nodes], frames[nodes, axis])
    return Supports(frames, held.reshape(-1, 3), Wall(nodes, axis, gap))


def _checked_growth(system: System, growth: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Growth of the solved elements."""
    if growth is None:
        return np.ones(len(system.material))
    if growth.shape != (len(system.head.elements),) or not np.all(growth > 0.0):
        problem = f"has shape {growth.shape} and a smallest value of {np.min(growth, initial=np.inf):g}"
        raise InputError("growth", problem, f"give {len(system.head.elements)} ratios of volume above zero")
    return growth[system.submesh.parent_element]

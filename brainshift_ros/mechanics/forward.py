"""One steady forward solution (spec P8): pressure where any acts, then the displacement of a linear elastic brain.

It is solved by a factorisation of its own for each set of held dofs: slow, simple, and the reference for
:mod:`brainshift_ros.solvers.many`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.mechanics.boundary import CAP_LEVEL, NodeKind, node_kinds
from brainshift_ros.mechanics.cases import Capillaries, Case
from brainshift_ros.mechanics.heights import unit_direction
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.skull import SkullName, skull_constraints
from brainshift_ros.mechanics.system import System, assemble_system
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.solvers.contact import TOLERANCE, BlockPivoting, most_iterations
from brainshift_ros.solvers.direct import SolverName, assert_residual, factorize, relative_residual


@dataclass(frozen=True)
class ForwardSolution:
    """A displacement field and how it was obtained.

    Attributes
    ----------
    displacement
        Shape (N, 3), m, patient frame, at every node of the mesh.
    kinds
        Shape (N,), :class:`~brainshift_ros.mechanics.boundary.NodeKind`; interior where resection left no tissue. With
        contact, `FREE` has left the skull (or is open), `CONTACT` touches it.
    residual
        Relative residual of the linear system.
    iterations
        Factorisations that were needed: one without contact.
    solver
        Name of the solver that was used.
    warnings
        What a person should know before trusting the solution.
    """

    displacement: NDArray[np.float64]
    kinds: NDArray[np.uint8]
    residual: float
    iterations: int
    solver: str
    warnings: tuple[str, ...]


def solve_gravity(
    mesh: TetMesh,
    material: Material,
    gravity_direction: ArrayLike,
    fluid_level: float,
    *,
    resected: bool = False,
    septa: bool = True,
    cap_level: float = CAP_LEVEL,
    skull: SkullName = "free_cap",
    opening: NDArray[np.bool_] | None = None,
    solver: SolverName = "auto",
) -> ForwardSolution:
    """Sag of a brain whose fluid has drained to a level.

    Parameters
    ----------
    mesh, material
        The patient's mesh and the properties of its elements.
    gravity_direction
        Along which gravity pulls, patient frame; any length.
    fluid_level
        Height of the fluid surface as a fraction of the head's extent along up; tissue above it has lost its buoyancy.
    resected, septa
        See :func:`~brainshift_ros.mechanics.system.assemble_system`.
    cap_level
        Demarcation of the stress-free cap, the same kind of fraction.
    skull, opening
        ``free_cap`` leaves the skull side free in the cap; ``contact`` lets it leave the skull there, but cross it only in
        the opening, a mask (N,) of nodes under the craniotomy.
    solver
        ``auto``, ``pardiso`` or ``scipy``.

    Raises
    ------
    InputError
        The mesh cannot be solved; see :func:`~brainshift_ros.mechanics.system.assemble_system`.
    ArithmeticError
        The residual is too large.
    """
    system = assemble_system(mesh, material, resected=resected, septa=septa, solver=solver)
    return solve_system(
        system, gravity_direction, fluid_level, cap_level=cap_level, skull=skull, opening=opening, solver=solver
    )


def solve_system(
    system: System,
    gravity_direction: ArrayLike,
    fluid_level: float,
    *,
    cap_level: float = CAP_LEVEL,
    skull: SkullName = "free_cap",
    opening: NDArray[np.bool_] | None = None,
    solver: SolverName = "auto",
) -> ForwardSolution:
    """:func:`solve_gravity` on an assembled system."""
    x, y, z = unit_direction(gravity_direction)
    case = Case("gravity", (x, y, z), fluid_level)
    return solve_case(system, case, cap_level=cap_level, skull=skull, opening=opening, solver=solver)


def solve_case(
    system: System,
    case: Case,
    *,
    cap_level: float = CAP_LEVEL,
    skull: SkullName = "free_cap",
    opening: NDArray[np.bool_] | None = None,
    solver: SolverName = "auto",
) -> ForwardSolution:
    """Steady solution of one case of any mechanism, with factorisations of its own for pressure and displacement.

    Parameters
    ----------
    system
        The elements.
    case
        What acts, and how the head lies.
    cap_level, skull, opening, solver
        As in :func:`solve_gravity`.

    Raises
    ------
    ArithmeticError
        A residual is too large.
    """
    held_sets, one_sided_sets = skull_constraints(system, [case.gravity_direction], skull, opening, cap_level)
    held = held_sets[0]
    one_sided = np.zeros_like(held) if one_sided_sets is None else one_sided_sets[0]
    load = _load(system, case, cap_level, solver)
    closed, pivoting = np.zeros_like(held), BlockPivoting()
    iterations = 0
    while True:
        iterations += 1
        if iterations > most_iterations(int(one_sided.sum())):
            raise ArithmeticError("contact: no set of closed dofs was found: is every element sound?")
        local, residual, name = _solve_held(system.stiffness, held | closed, load, solver)
        wrong = _wrong_sides(system, local, load, one_sided, closed)
        if len(wrong) == 0:
            break
        closed[pivoting.exchange(wrong)] ^= True
    kinds = _kinds_of_head(system, held, closed)
    return ForwardSolution(system.displacement(local[:, None])[:, :, 0], kinds, residual, iterations, name, system.warnings)


def _load(system: System, case: Case, cap_level: float, solver: SolverName) -> NDArray[np.float64]:
    """Load (3n,) of a case: the weight, or the gradient of the pressure that its capillaries make."""
    if case.mechanism == "gravity":
        return system.gravity(case.gravity_direction, case.fluid_level)
    capillaries, fluid = Capillaries(system), system.fluid
    exchange = capillaries.exchange(case)
    source = fluid.source(exchange, capillaries.pressure(case))
    drained = system.stress_free(case.gravity_direction, cap_level)
    pressure, _, _ = _solve_held(fluid.helmholtz(exchange), drained, source, solver)
    return system.pressure_load(pressure)


def _solve_held(
    matrix: sp.csr_matrix, held: NDArray[np.bool_], load: NDArray[np.float64], solver: SolverName
) -> tuple[NDArray[np.float64], float, str]:
    """Solution (n,) with some dofs held at zero, its relative residual, and the solver's name."""
    free = np.flatnonzero(~held)
    matrix = matrix[free][:, free].tocsr()
    factorization = factorize(matrix, solver)
    solution = factorization.solve(load[free, None])
    residual = relative_residual(matrix, solution, load[free, None])
    assert_residual(residual, factorization.name)
    local = np.zeros_like(load)
    local[free] = solution[:, 0]
    return local, residual, factorization.name


def _wrong_sides(
    system: System,
    local: NDArray[np.float64],
    load: NDArray[np.float64],
    one_sided: NDArray[np.bool_],
    closed: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """One-sided dofs that cross the skull, or are pulled by it."""
    reaction = system.stiffness @ local - load
    crossing = TOLERANCE * np.abs(local).max(initial=0.0)
    pulling = TOLERANCE * max(np.abs(reaction).max(initial=0.0), np.abs(load).max(initial=0.0))
    return np.flatnonzero(one_sided & np.where(closed, reaction > pulling, local > crossing))


def _kinds_of_head(system: System, held: NDArray[np.bool_], closed: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Kinds (N,) of the head's nodes."""
    axis = system.boundary.skull_axis
    node = np.arange(len(axis))
    of_space = node_kinds(system.boundary, (axis >= 0) & ~held.reshape(-1, 3)[node, axis])
    of_space[closed.reshape(-1, 3).any(axis=1)] = NodeKind.CONTACT
    kinds = np.full(len(system.head.nodes), NodeKind.INTERIOR, dtype=np.uint8)
    solved = system.submesh.node_of >= 0
    kinds[solved] = of_space[system.submesh.node_of[solved]]
    return kinds

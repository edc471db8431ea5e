"""One forward solution: sag under gravity of a linear elastic brain (spec P8, steady, no pressure acting)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.mechanics.boundary import CAP_LEVEL, node_kinds
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.solvers import SolverName, assert_residual, factorize, relative_residual
from brainshift_ros.mechanics.system import System, assemble_system
from brainshift_ros.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class ForwardSolution:
    """A displacement field and how it was obtained.

    Attributes
    ----------
    displacement
        Shape (N, 3), m, patient frame, at every node of the mesh.
    kinds
        Shape (N,), :class:`~brainshift_ros.mechanics.boundary.NodeKind`; interior where resection left no tissue.
    residual
        Relative residual of the linear system.
    solver
        Name of the solver that was used.
    warnings
        What a person should know before trusting the solution.
    """

    displacement: NDArray[np.float64]
    kinds: NDArray[np.uint8]
    residual: float
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
    solver: SolverName = "auto",
) -> ForwardSolution:
    """Sag of the brain when the fluid that carried it has drained to a level.

    Parameters
    ----------
    mesh, material
        The patient's mesh and the properties of its elements.
    gravity_direction
        Where gravity pulls, patient frame; any length.
    fluid_level
        Height of the fluid along up, as a fraction of the head's extent (0 lowest node, 1 highest).
    resected
        Remove the tumour's elements. Nodes that only they carry get the harmonic extension of the cavity wall's motion.
    septa
        Falx and tentorium as slip sheets, or none.
    cap_level
        Demarcation of the stress-free cap, same scale as `fluid_level`.
    solver
        ``auto``, ``pardiso`` or ``scipy``.

    Raises
    ------
    InputError
        See :func:`~brainshift_ros.mechanics.system.assemble_system`.
    ArithmeticError
        The solution's residual is too large.
    """
    system = assemble_system(mesh, material, resected=resected, septa=septa, solver=solver)
    return solve_system(system, gravity_direction, fluid_level, cap_level=cap_level, solver=solver)


def solve_system(
    system: System,
    gravity_direction: ArrayLike,
    fluid_level: float,
    *,
    cap_level: float = CAP_LEVEL,
    solver: SolverName = "auto",
) -> ForwardSolution:
    """:func:`solve_gravity` on an assembled system, with a factorisation of its own."""
    free = np.flatnonzero(~system.constrained(gravity_direction, cap_level))
    matrix = system.stiffness[free][:, free].tocsr()
    load = system.gravity(gravity_direction, fluid_level)[free, None]
    factorization = factorize(matrix, solver)
    solution = factorization.solve(load)
    residual = relative_residual(matrix, solution, load)
    assert_residual(residual, factorization.name)
    local = np.zeros((system.stiffness.shape[0], 1))
    local[free] = solution
    kinds = np.zeros(len(system.head.nodes), dtype=np.uint8)
    solved = system.submesh.node_of >= 0
    kinds[solved] = node_kinds(system.boundary, system.cap(gravity_direction, cap_level))[system.submesh.node_of[solved]]
    return ForwardSolution(system.displacement(local)[:, :, 0], kinds, residual, factorization.name, system.warnings)

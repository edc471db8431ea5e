"""One set of elements made ready to solve: derived mesh, stiffness in local frames, boundary, loads, expansion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.boundary import CAP_LEVEL, Boundary, boundary_of, constrained_dofs, in_cap
from brainshift_ros.mechanics.elasticity import assemble_stiffness
from brainshift_ros.mechanics.extension import Extend, harmonic_extension
from brainshift_ros.mechanics.fluid import Fluid, fluid_of
from brainshift_ros.mechanics.heights import checked_levels, heights_over_levels, unit_direction
from brainshift_ros.mechanics.loads import TissueWeight
from brainshift_ros.mechanics.materials import GRAVITY, Material
from brainshift_ros.mechanics.resection import solved_elements
from brainshift_ros.mechanics.slivers import sliver_warnings
from brainshift_ros.mechanics.space import ElementName, Space, space_of
from brainshift_ros.mechanics.submesh import Submesh
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.solvers.direct import SolverName


@dataclass(frozen=True)
class System:
    """What all solutions on one set of elements share.

    Attributes
    ----------
    head
        The patient's whole mesh, N nodes: levels are fractions of *its* extent, also after resection.
    submesh
        The elements that are solved.
    space
        The displacement's nodes on them, n; the first are the derived mesh's vertices.
    volume, material
        Volume in m^3 and properties of those elements.
    boundary
        Normals, local frames and fixed nodes of the space.
    rotation
        Sparse (3n, 3n) from patient to local components.
    stiffness
        Sparse (3n, 3n) in local components, without boundary conditions.
    extend
        Fills head nodes that no solved element carries.
    warnings
        What was done to the mesh beyond what was asked.
    """

    head: TetMesh
    submesh: Submesh
    space: Space
    volume: NDArray[np.float64]
    material: Material
    boundary: Boundary
    rotation: sp.csr_matrix
    stiffness: sp.csr_matrix
    extend: Extend
    warnings: tuple[str, ...]

    @cached_property
    def fluid(self) -> Fluid:
        """Pressure on the derived mesh's vertices; made when first asked for, since gravity alone needs none."""
        return fluid_of(self.space.basis, self.material)

    @cached_property
    def _weight(self) -> TissueWeight:
        return TissueWeight(self.space, self.volume, self.material.density)

    def cap(self, gravity_direction: ArrayLike, cap_level: float = CAP_LEVEL) -> NDArray[np.bool_]:
        """Nodes (n,) of the space in the stress-free cap."""
        return in_cap(self.head.nodes, gravity_direction, cap_level, self.space.points)

    def constrained(self, gravity_direction: ArrayLike, cap_level: float = CAP_LEVEL) -> NDArray[np.bool_]:
        """Local dofs (3n,) that are held at zero by the model `free_cap`."""
        return constrained_dofs(self.boundary, self.cap(gravity_direction, cap_level)).ravel()

    def held_and_one_sided(
        self, gravity_direction: ArrayLike, cap_level: float = CAP_LEVEL, opening: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Local dofs that the model `contact` holds at zero, and those that the skull keeps from becoming positive.

        Where `free_cap` leaves the skull normal free, tissue may here leave the skull but not cross it; only the opening
        is free, wherever it lies.

        Parameters
        ----------
        gravity_direction, cap_level
            Of the cap.
        opening
            Shape (N,), nodes of the head under the craniotomy; None is a closed skull.

        Returns
        -------
        Two masks (3n,) without common dofs.
        """
        in_opening = np.zeros(len(self.head.nodes), dtype=bool) if opening is None else opening
        free = self.space.spread(in_opening[self.submesh.parent_node])
        cap = self.cap(gravity_direction, cap_level)
        held = constrained_dofs(self.boundary, cap | free)
        one_sided = np.zeros_like(held)
        nodes = np.flatnonzero(cap & ~free & (self.boundary.skull_axis >= 0) & ~self.boundary.fixed)
        one_sided[nodes, self.boundary.skull_axis[nodes]] = True
        return held.ravel(), one_sided.ravel()

    def drained(self, gravity_direction: ArrayLike, level: float, cavity: bool = True) -> NDArray[np.bool_]:
        """Vertices of the derived mesh on its surface above a level: air is there, the pressure zero.

        `cavity` says whether the wall that resection opened counts as such a surface, beside the skull side.
        """
        count = self.space.vertex_count
        surface = self.boundary.outer[:count] | (self.boundary.wall[:count] & cavity)
        return surface & self.cap(gravity_direction, level)[:count]

    def stress_free(self, gravity_direction: ArrayLike, cap_level: float = CAP_LEVEL) -> NDArray[np.bool_]:
        """Vertices of the derived mesh in the stress-free cap or on the cavity's wall: there mannitol's model drains."""
        return self.drained(gravity_direction, cap_level) | self.boundary.wall[: self.space.vertex_count]

    def gravity(self, gravity_direction: ArrayLike, fluid_level: float) -> NDArray[np.float64]:
        """Gravity load in local components, shape (3n,), N."""
        return self.gravity_loads(np.asarray(gravity_direction, dtype=np.float64)[None], [fluid_level])[:, 0]

    def gravity_loads(self, gravity_directions: ArrayLike, fluid_levels: ArrayLike) -> NDArray[np.float64]:
        """Gravity loads (3n, k), N, of k directions (k, 3) and fluid levels (k,), in local components."""
        down = np.stack([unit_direction(direction) for direction in np.asarray(gravity_directions)], axis=1)
        levels = checked_levels(fluid_levels)
        masses = self._weight.masses(heights_over_levels(self.head.nodes, -down, levels, self.space.mesh.nodes))
        loads = (self.boundary.frames.reshape(-1, 3) @ (GRAVITY * down)).reshape(len(masses), 3, -1)
        loads *= masses[:, None]
        return loads.reshape(3 * len(masses), -1)

    def pressure_load(self, pressure: NDArray[np.float64]) -> NDArray[np.float64]:
        """Load (3n,) or (3n, k), N, of the pressure gradient in local components, for p at the vertices, Pa.

        In the weak form of (3.1) it is the integral of alpha p div v: high pressure pushes the tissue apart.
        """
        return self.rotation @ (self.fluid.coupling @ pressure)

    def displacement(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """From local components (3n, k) to displacements at all the head's nodes, (N, 3, k), patient frame, m.

        Those at mid-edges are left out: the head's nodes are vertices.
        """
        at_nodes = local.reshape(len(self.space), 3, -1)
        expanded = np.zeros((len(self.head.nodes), 3, local.shape[1]))
        solved = np.flatnonzero(self.submesh.node_of >= 0)
        node = self.submesh.node_of[solved]
        expanded[solved] = at_nodes[node]
        turned = np.flatnonzero(self.boundary.turned[node])
        axes = self.boundary.frames[node[turned]].swapaxes(1, 2)
        expanded[solved[turned]] = axes @ at_nodes[node[turned]]
        return self.extend(expanded.reshape(len(expanded), -1)).reshape(expanded.shape)


def assemble_system(
    mesh: TetMesh,
    material: Material,
    *,
    resected: bool = False,
    septa: bool = True,
    element: ElementName = "P1",
    solver: SolverName = "auto",
) -> System:
    """Make one set of elements ready to solve.

    Parameters
    ----------
    mesh, material
        The patient's mesh and the properties of its elements.
    resected
        Remove the tumour's elements (those with region `TUMOR`); the wall they leave is stress-free.
    septa
        Keep the falx and the tentorium as slip sheets; without them a split mesh is joined again.
    element
        ``P1``, linear, or ``P2``, quadratic displacement.
    solver
        For the extension into the cavity.

    Raises
    ------
    InputError
        Mesh and material differ in size, an element is inverted, the brain hangs on nothing, or there is no tumour.
    """
    if len(material) != len(mesh.elements):
        problem = f"it has {len(material)} elements, the mesh {len(mesh.elements)}"
        raise InputError("material", problem, "make it from this mesh's tissue")
    volume = mesh.volumes
    inverted = int((volume <= 0.0).sum())
    if inverted:
        raise InputError("mesh", f"{inverted} elements have no positive volume", "make the mesh again")
    submesh, warnings = solved_elements(mesh, resected=resected, septa=septa)
    warnings += sliver_warnings(mesh.nodes, mesh.elements, volume)
    space = space_of(submesh.mesh, element)
    boundary = boundary_of(space)
    kept = material.select(submesh.parent_element)
    return System(
        head=mesh,
        submesh=submesh,
        space=space,
        volume=volume[submesh.parent_element],
        material=kept,
        boundary=boundary,
        rotation=boundary.rotation(),
        stiffness=assemble_stiffness(space, kept, boundary.frames),
        extend=harmonic_extension(mesh, submesh.node_of >= 0, solver),
        warnings=warnings,
    )

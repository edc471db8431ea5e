"""One set of elements made ready to solve: derived mesh, stiffness in local frames, boundary, loads, expansion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.boundary import CAP_LEVEL, Boundary, boundary_of, constrained_dofs, in_cap
from brainshift_ros.mechanics.elasticity import assemble_stiffness
from brainshift_ros.mechanics.extension import Extend, harmonic_extension
from brainshift_ros.mechanics.heights import height_over_level, unit_direction
from brainshift_ros.mechanics.loads import gravity_load
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.solvers import SolverName
from brainshift_ros.mechanics.submesh import Submesh, compose, join_septa, remove_elements, unsupported_elements, whole
from brainshift_ros.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class System:
    """What all solutions on one set of elements share.

    Attributes
    ----------
    head
        The patient's whole mesh: levels are fractions of *its* extent, also after resection.
    submesh
        The elements that are solved.
    volume, material
        Volume in m^3 and properties of those elements.
    boundary
        Normals, local frames and fixed nodes on the derived mesh.
    rotation
        Sparse (3n, 3n) from patient to local components.
    stiffness
        Sparse (3n, 3n) in local components, without boundary conditions.
    extend
        Fills nodes that no solved element carries.
    warnings
        What was done to the mesh beyond what was asked.
    """

    head: TetMesh
    submesh: Submesh
    volume: NDArray[np.float64]
    material: Material
    boundary: Boundary
    rotation: sp.csr_matrix
    stiffness: sp.csr_matrix
    extend: Extend
    warnings: tuple[str, ...]

    def cap(self, gravity_direction: ArrayLike, cap_level: float = CAP_LEVEL) -> NDArray[np.bool_]:
        """Nodes (n,) of the derived mesh in the stress-free cap."""
        return in_cap(self.head.nodes, gravity_direction, cap_level)[self.submesh.parent_node]

    def constrained(self, gravity_direction: ArrayLike, cap_level: float = CAP_LEVEL) -> NDArray[np.bool_]:
        """Local dofs (3n,) that are held at zero."""
        return constrained_dofs(self.boundary, self.cap(gravity_direction, cap_level)).ravel()

    def gravity(self, gravity_direction: ArrayLike, fluid_level: float) -> NDArray[np.float64]:
        """Gravity load in local components, shape (3n,), N."""
        height = height_over_level(self.head.nodes, gravity_direction, fluid_level)[self.submesh.parent_node]
        elements = self.submesh.mesh.elements
        load = gravity_load(elements, self.volume, self.material, unit_direction(gravity_direction), height)
        return self.rotation @ load.ravel()

    def displacement(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """From local components (3n, k) to displacements at all the head's nodes, (N, 3, k), patient frame, m."""
        count = local.shape[1]
        patient = (self.rotation.T @ local).reshape(-1, 3 * count)
        expanded = np.zeros((len(self.head.nodes), 3 * count))
        solved = self.submesh.node_of >= 0
        expanded[solved] = patient[self.submesh.node_of[solved]]
        return self.extend(expanded).reshape(-1, 3, count)


def assemble_system(
    mesh: TetMesh, material: Material, *, resected: bool = False, septa: bool = True, solver: SolverName = "auto"
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
    warnings: list[str] = []
    base = whole(mesh) if septa else join_septa(mesh)
    removed = np.zeros(len(mesh.elements), dtype=bool)
    loose = unsupported_elements(base.mesh, removed)
    if loose.any():
        problem = f"{int(loose.sum())} elements share no face with the part that the brainstem holds"
        raise InputError("mesh", problem, "make the mesh again as one piece")
    if resected:
        removed = base.mesh.region == Region.TUMOR
        if not removed.any():
            raise InputError("mesh", "it has no tumour to resect", "give a tumour, or set `resection: none` in the scene")
        loose = unsupported_elements(base.mesh, removed)
        if loose.any():
            warnings.append(f"{int(loose.sum())} elements lost their hold with the tumour and were removed with it")
        removed |= loose
    rest = remove_elements(base.mesh, removed)
    submesh = compose(base, rest)
    touched = np.zeros(len(base.mesh.nodes), dtype=bool)
    touched[base.mesh.elements[removed]] = True
    boundary = boundary_of(submesh.mesh, touched[rest.parent_node])
    kept = material.select(submesh.parent_element)
    rotation = boundary.rotation()
    stiffness = (rotation @ assemble_stiffness(submesh.mesh, kept) @ rotation.T).tocsr()
    extend = harmonic_extension(mesh, submesh.node_of >= 0, solver)
    kept_volume = volume[submesh.parent_element]
    return System(mesh, submesh, kept_volume, kept, boundary, rotation, stiffness, extend, tuple(warnings))

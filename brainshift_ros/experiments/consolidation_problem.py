"""Columns and balls under pressure, discretised: what the analytic solutions of consolidation are compared with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from skfem import FacetBasis, LinearForm, MeshTet
from skfem.helpers import dot

from brainshift_ros.experiments.consolidation_analytic import PorousMedium
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.consolidation import BackwardEuler, State, march, time_steps
from brainshift_ros.mechanics.elasticity import assemble_stiffness, lame_parameters
from brainshift_ros.mechanics.fluid import Fluid, fluid_of
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.space import ElementName, Space, space_of
from brainshift_ros.mechanics.stabilization import stabilization
from brainshift_ros.mesh.tetmesh import TetMesh, tetrahedron_volumes
from brainshift_ros.solvers.many import ManySolver

#: Coordinates this close to a plane, relative to the body's size, lie on it.
_ON = 1e-9


@dataclass(frozen=True)
class Problem:
    """A body at rest that is loaded at t = 0+.

    Attributes
    ----------
    space
        Displacement space, n nodes.
    fluid
        Pressure on its N vertices, and the material.
    stiffness
        Sparse (3n, 3n).
    held
        Shape (3n + N,), displacements and pressures that stay zero.
    force
        Shape (3n,), N.
    """

    space: Space
    fluid: Fluid
    stiffness: sp.csr_matrix
    held: NDArray[np.bool_]
    force: NDArray[np.float64]

    def follow(self, duration_s: float, count: int, term: sp.csr_matrix | None = None) -> Iterator[State]:
        """Follow it in equal steps, with another stabilisation (N, N) than the default if one is given."""
        material = self.fluid.material
        kept = stabilization(self.fluid) if term is None else term
        storage = (kept + sp.diags_array(self.fluid.lumped(material.storage))).tocsr()
        flow = self.fluid.helmholtz(material.exchange_at(0.0))
        steps = time_steps(duration_s, duration_s / count)
        step = BackwardEuler(self.stiffness, self.fluid.coupling, storage, flow, steps.dt_s)
        solver = ManySolver(step.matrix, self.held[None], definite=False)
        return march(step, solver, [0], self.force[:, None], np.zeros((len(self.fluid), 1)), steps.count)

    def error(self, pressure: NDArray[np.float64], exact: NDArray[np.float64], scale: float) -> float:
        """Root mean square over the volume of the difference of two pressures (N,), relative to a pressure."""
        mass = self.fluid.lumped(np.ones(len(self.fluid.material)))
        return float(np.sqrt((mass * (pressure - exact) ** 2).sum() / mass.sum()) / scale)


def column(
    medium: PorousMedium,
    cells: tuple[int, int, int],
    size: tuple[float, float, float],
    load: float,
    *,
    element: ElementName = "P1",
    irregular: float = 0.0,
    conductivity: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
) -> Problem:
    """Terzaghi's column: base and sides slip and let nothing through; the top is loaded and drained.

    Parameters
    ----------
    medium
        The material.
    cells, size
        Number of cells and edges in m along x, y, z.
    load
        Pressure on the top, Pa.
    element
        Of the displacement.
    irregular
        Inner nodes are moved at random by up to this part of a cell.
    conductivity
        From heights of elements (M,) in m to their k, instead of the medium's.
    """
    lines = [np.linspace(0.0, length, count + 1) for length, count in zip(size, cells, strict=True)]
    grid = MeshTet.init_tensor(*lines)
    points = grid.p.T.copy()
    inner = np.all((points > _ON) & (points < np.array(size) - _ON), axis=1)
    moves = np.random.default_rng(0).uniform(-irregular, irregular, (int(inner.sum()), 3))
    points[inner] += moves * np.array(size) / np.array(cells)
    space = space_of(_mesh(points, grid.t.T), element)
    height = space.mesh.nodes[space.mesh.elements].mean(axis=1)[:, 2]
    x, wide = space.points, np.array(size) * _ON
    held = np.stack([(x[:, c] < wide[c]) | ((c < 2) & (x[:, c] > size[c] - wide[c])) for c in range(3)], axis=1)
    material = _material(medium, len(height), None if conductivity is None else conductivity(height))
    return _problem(space, material, held, lambda p: p[2] > size[2] - wide[2], load)


def ball(medium: PorousMedium, cells: int, radius: float, load: float, *, element: ElementName = "P1") -> Problem:
    """Cryer's ball, of which an eighth is meshed: it slips on the planes of symmetry; the sphere is loaded and drained.

    Parameters
    ----------
    medium
        The material.
    cells
        Along a radius.
    radius
        m.
    load
        Pressure on the sphere, Pa.
    element
        Of the displacement.
    """
    grid = MeshTet.init_tensor(*[np.linspace(0.0, 1.0, cells + 1)] * 3)
    largest, length = grid.p.max(axis=0), np.linalg.norm(grid.p, axis=0)
    points = (radius * grid.p * (largest / np.where(length > 0.0, length, 1.0))).T
    space = space_of(_mesh(points, grid.t.T), element)
    held = space.points < radius * _ON
    sphere = radius * (1.0 - _ON)
    return _problem(space, _material(medium, len(space.elements)), held, lambda p: np.linalg.norm(p, axis=0) > sphere, load)


def brezzi_pitkaranta(fluid: Fluid, length: NDArray[np.float64], factor: float) -> sp.csr_matrix:
    """Build the classical term, factor alpha^2 h^2 / (lambda + 2 mu) grad p . grad q, for a length h (M,) of each element."""
    material = fluid.material
    first, shear = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    conductivity = factor * material.biot**2 * length**2 / (first + 2.0 * shear)
    return fluid_of(fluid.displacement, replace(material, conductivity=conductivity)).conductance


def edge_lengths(fluid: Fluid) -> NDArray[np.float64]:
    """Lengths of the six edges of each element, shape (M, 6), m."""
    first, second = np.triu_indices(4, 1)
    points = fluid.displacement.mesh.p.T[fluid.elements]
    return np.linalg.norm(points[:, first] - points[:, second], axis=2)


def _problem(
    space: Space,
    material: Material,
    held: NDArray[np.bool_],
    drained: Callable[[NDArray[np.float64]], NDArray[np.bool_]],
    load: float,
) -> Problem:
    """Problem with facets that carry a pressure and are drained: outer ones whose corners (3, 3, F) are all chosen."""
    basis = space.basis
    outer = basis.mesh.boundary_facets()
    loaded = outer[drained(basis.mesh.p[:, basis.mesh.facets[:, outer]]).all(axis=0)]
    force = LinearForm(lambda v, w: -load * dot(w.n, v)).assemble(FacetBasis(basis.mesh, basis.elem, facets=loaded))
    open_to_air = np.zeros(space.vertex_count, dtype=bool)
    open_to_air[basis.mesh.facets[:, loaded]] = True
    fluid = fluid_of(basis, material)
    return Problem(space, fluid, assemble_stiffness(space, material), np.append(held.ravel(), open_to_air), force)


def _material(medium: PorousMedium, count: int, conductivity: NDArray[np.float64] | None = None) -> Material:
    def every(value: float) -> NDArray[np.float64]:
        return np.full(count, value)

    return Material(
        youngs_modulus=every(medium.youngs_modulus),
        poissons_ratio=every(medium.poissons_ratio),
        density=every(1000.0),
        conductivity=every(medium.conductivity) if conductivity is None else conductivity,
        exchange=np.zeros((count, 2)),
        biot=every(medium.biot),
        storage=every(medium.storage),
    )


def _mesh(points: NDArray[np.float64], elements: NDArray[np.integer]) -> TetMesh:
    """Mesh whose elements all have positive volume."""
    turned = elements.astype(np.int32)
    negative = tetrahedron_volumes(points, turned) < 0.0
    turned[negative] = turned[negative][:, [0, 2, 1, 3]]
    return TetMesh(points, turned, np.full(len(turned), Region.LEFT_CEREBRUM, dtype=np.uint8))

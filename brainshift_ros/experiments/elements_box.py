"""Linear against quadratic elements on a box with a known solution, part of :mod:`brainshift_ros.experiments.elements`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from skfem import Basis, Functional, LinearForm, MeshTet

from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.elasticity import assemble_stiffness
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.space import ElementName, Space, space_of
from brainshift_ros.mesh.tetmesh import TetMesh, tetrahedron_volumes
from brainshift_ros.solvers.direct import factorize

#: Edge of the box, m; wave vectors in units of pi over that edge, and amplitudes orthogonal to them.
SIDE_M = 0.1
_WAVES = np.array([[1.0, 2.0, 0.0], [0.0, 1.0, -2.0], [2.0, 0.0, 1.0]]) * np.pi / SIDE_M
_AMPLITUDES_M = np.array([[2.0, -1.0, 1.0], [1.0, 2.0, 1.0], [1.0, -1.0, -2.0]]) * 1e-3
_PHASES = np.array([0.3, 1.1, 2.0])

#: Quadrature for load and error, fine enough that only the elements' own error shows.
_ORDER = 6


def exact(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Displacement at points, first axis x, y, z, m: plane waves across their own directions, so free of divergence."""
    angle = np.tensordot(_WAVES, points, axes=1) + _PHASES.reshape(-1, *[1] * (points.ndim - 1))
    return np.tensordot(_AMPLITUDES_M.T, np.sin(angle), axes=1)


def body_force(points: NDArray[np.float64], shear: float) -> NDArray[np.float64]:
    """Force per volume that makes :func:`exact` the solution: -mu times its Laplacian, whatever Poisson's ratio."""
    angle = np.tensordot(_WAVES, points, axes=1) + _PHASES.reshape(-1, *[1] * (points.ndim - 1))
    square = np.sum(_WAVES**2, axis=1)
    return shear * np.tensordot((_AMPLITUDES_M * square[:, None]).T, np.sin(angle), axes=1)


def box_space(cells: int, element: ElementName) -> Space:
    """Structured tetrahedra, `cells` cubes along each edge of the box."""
    axis = np.linspace(0.0, SIDE_M, cells + 1)
    mesh = MeshTet.init_tensor(axis, axis, axis)
    nodes, elements = np.ascontiguousarray(mesh.p.T), mesh.t.T.astype(np.int32)
    inverted = tetrahedron_volumes(nodes, elements) < 0.0
    elements[inverted] = elements[inverted][:, [0, 2, 1, 3]]
    return space_of(TetMesh(nodes, elements, np.full(len(elements), Region.LEFT_CEREBRUM, np.uint8)), element)


def box_row(cells: int, element: ElementName, poissons_ratio: float) -> dict[str, Any]:
    """Solve with the exact displacement on the whole boundary; relative L2 error, and what assembly and solution took."""
    space = box_space(cells, element)
    count = len(space.elements)
    youngs_modulus = 2100.0
    shear = youngs_modulus / (2.0 * (1.0 + poissons_ratio))
    material = Material(np.full(count, youngs_modulus), np.full(count, poissons_ratio), np.full(count, 1000.0))
    fine = Basis(space.skfem_mesh, space.basis.elem, intorder=_ORDER)
    load = LinearForm(lambda v, w: np.einsum("i...,i...->...", body_force(w.x, shear), v)).assemble(fine)
    boundary = np.any(np.isclose(space.points, 0.0) | np.isclose(space.points, SIDE_M), axis=1)
    inner = np.flatnonzero(~np.repeat(boundary, 3))
    u = np.where(boundary[:, None], exact(space.points.T).T, 0.0).ravel()
    with Stopwatch() as watch:
        stiffness = assemble_stiffness(space, material)
        rhs = (load - stiffness @ u)[inner, None]
        u[inner] = factorize(stiffness[inner][:, inner].tocsr()).solve(rhs)[:, 0]
    return {
        "case": f"box, nu {poissons_ratio:g}",
        "element": element,
        "vertices": space.vertex_count,
        "dofs": len(u),
        "error": _relative_error(fine, u),
        "cpu_s": watch.cpu_s,
    }


def _relative_error(basis: Basis, u: NDArray[np.float64]) -> float:
    def square(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.sum(values**2, axis=0)

    error = Functional(lambda w: square(w["u"] - exact(w.x))).assemble(basis, u=basis.interpolate(u))
    norm = Functional(lambda w: square(exact(w.x))).assemble(basis)
    return float(np.sqrt(error / norm))

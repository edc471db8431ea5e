"""Surfaces that move with the tissue, and their files: triangles in mm, RAS."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.files import atomic_path, existing_file, writable_target
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm, mm_to_m

#: Surfaces that a field's mesh carries, and its names of their facets.
PARTS = {"brain": "skull", "falx": "falx", "tentorium": "tentorium", "tumor": "tumor"}

#: What surface files may be called. STL and OBJ hold the triangles alone.
SURFACE_SUFFIXES = (".vtu", ".vtk", ".ply", ".stl", ".obj")

#: Vertices this near to the mesh have its standard deviation, metres: a cortex from the MR is finer than the mesh.
_NEAR = 0.005


@dataclass(frozen=True)
class WarpedSurface:
    """A surface brought to the present.

    Attributes
    ----------
    surface
        Where it is now.
    displacement
        Shape (V, 3), metres: how its vertices came there.
    std
        Shape (V,), standard deviation of a component, metres; NaN more than 5 mm outside the mesh.
    """

    surface: Surface
    displacement: NDArray[np.float64]
    std: NDArray[np.float64]


def warp_surface(deformation: Deformation, surface: Surface) -> WarpedSurface:
    """Move any surface of the patient frame with the tissue."""
    displacement = deformation.forward_at(surface.vertices)
    located = deformation.locator.locate(surface.vertices, max_outside_m=_NEAR)
    std = located.interpolate(deformation.field.mesh, deformation.field.std)
    return WarpedSurface(Surface(surface.vertices + displacement, surface.faces), displacement, std)


def warp_part(deformation: Deformation, name: str) -> WarpedSurface:
    """Move a surface that the mesh carries: one of :data:`PARTS`. Falx and tentorium come with both of their sides.

    Raises
    ------
    InputError
        The mesh has no such surface.
    """
    field = deformation.field
    facets = field.mesh.facets.get(PARTS[name])
    if facets is None or len(facets) == 0:
        there = ", ".join(part for part, facet in PARTS.items() if len(field.mesh.facets.get(facet, ()))) or "none"
        raise InputError(f"surface {name}", "is not in the field's mesh", f"choose one that is ({there}), or give a file")
    nodes, faces = np.unique(facets, return_inverse=True)
    surface = Surface(deformation.deformed_nodes[nodes], faces.reshape(-1, 3).astype(np.int32))
    return WarpedSurface(surface, field.displacement[nodes], field.std[nodes])


def read_surface(path: str | Path) -> Surface:
    """Read triangles in mm, RAS, from any file that meshio reads.

    Raises
    ------
    InputError
        Missing, unreadable, without triangles, or with points that are not finite.
    """
    path = existing_file(path, "surface (.vtu, .vtk, .ply, .stl, .obj)")
    try:
        mesh = meshio.read(path)
    # meshio's readers let whatever goes wrong inside them through
    except (Exception, SystemExit) as error:
        problem = f"cannot be read as a surface ({type(error).__name__})"
        raise InputError(path, problem, f"write it again as {SURFACE_SUFFIXES[0]}") from error
    faces = mesh.get_cells_type("triangle")
    if len(faces) == 0:
        raise InputError(path, "holds no triangles", "write it again as triangles")
    if not np.isfinite(mesh.points).all():
        raise InputError(path, "holds points that are not finite", "write it again")
    return Surface(mm_to_m(mesh.points), faces.astype(np.int32))


def write_surface(path: str | Path, warped: WarpedSurface) -> None:
    """Write a moved surface in mm, RAS, with its shift and standard deviation at each vertex where the format can.

    Parameters
    ----------
    path
        The suffix chooses the format, one of :data:`SURFACE_SUFFIXES`.
    warped
        What to write. Point data: ``shift_mm``, the length of the displacement, and ``std_mm``.
    """
    path = writable_target(path, SURFACE_SUFFIXES)
    data = {"shift_mm": m_to_mm(np.linalg.norm(warped.displacement, axis=1)), "std_mm": m_to_mm(warped.std)}
    keeps_data = path.suffix not in (".stl", ".obj")
    mesh = meshio.Mesh(
        m_to_mm(warped.surface.vertices), [("triangle", warped.surface.faces)], point_data=data if keeps_data else {}
    )
    with atomic_path(path) as temporary:
        meshio.write(temporary, mesh)

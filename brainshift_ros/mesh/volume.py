"""Give a meshed body back the volume that flat facets cut off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.facets import face_table, facet_areas
from brainshift_ros.mesh.quality import dihedral_angles_deg

#: A moved element may lose this share of the surface elements' smallest dihedral angle.
_ANGLE_LOSS = 0.1


def restore_volume(
    nodes: NDArray[np.float64], elements: NDArray[np.int32], body: NDArray[np.bool_], volume: float
) -> NDArray[np.float64]:
    """Move the surface nodes of a body along their normals until it has the given volume.

    A facet whose corners lie on a convex surface cuts a cap off, and the mesher's envelope lets it cut more; over the
    whole surface that is a few tenths of a millimetre. Nodes whose move would spoil an element stay.

    Parameters
    ----------
    nodes, elements
        The mesh, shapes (N, 3) in metres and (M, 4).
    body
        Shape (M,), the elements of the body.
    volume
        Wanted, m^3.

    Returns
    -------
    ndarray
        Nodes, shape (N, 3), metres.
    """
    facets = _outward_facets(elements, body)
    a, b, c = np.moveaxis(nodes[facets], 1, 0)
    normals = np.zeros_like(nodes)
    np.add.at(normals, facets.ravel(), np.repeat(np.cross(b - a, c - a), 3, axis=0))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
    on_surface = np.zeros(len(nodes), dtype=bool)
    on_surface[facets] = True
    near = elements[on_surface[elements].any(axis=1)]
    lowest = (1.0 - _ANGLE_LOSS) * dihedral_angles_deg(nodes, near).min()
    moved = nodes
    for _ in range(4):
        missing = volume - _volumes(moved, elements[body]).sum()
        trial = moved + missing / facet_areas(moved, facets).sum() * normals
        spoiled = _volumes(trial, near) <= 0.0
        spoiled |= dihedral_angles_deg(trial, near).min(axis=1) < lowest
        normals[near[spoiled].ravel()] = 0.0
        moved = np.where(normals.any(axis=1, keepdims=True), trial, moved)
        if spoiled.any():
            moved = nodes
    return moved


def _outward_facets(elements: NDArray[np.int32], body: NDArray[np.bool_]) -> NDArray[np.int32]:
    table = face_table(elements)
    inner = body[table.owners]
    interface = inner[:, 0] != inner[:, 1]
    turned = np.where(inner[interface, :1], table.interior[interface], table.interior[interface, ::-1])
    return np.vstack([turned, table.boundary[body[table.boundary_owner]]])


def _volumes(nodes: NDArray[np.float64], elements: NDArray[np.int32]) -> NDArray[np.float64]:
    x = nodes[elements]
    return np.linalg.det(x[:, 1:] - x[:, :1]) / 6.0

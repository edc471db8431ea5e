"""Give a meshed body back the volume that flat facets cut off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.quality import dihedral_angles_deg
from brainshift_ros.mesh.tetmesh import tetrahedron_volumes
from brainshift_ros.surface.facets import face_table

_ROUNDS = 6

#: A move may take this share of an element's smallest dihedral angle where that ends below the floor.
_ANGLE_LOSS = 0.1


def restore_volume(
    nodes: NDArray[np.float64],
    elements: NDArray[np.int32],
    body: NDArray[np.bool_],
    volume: float,
    *,
    held: NDArray[np.bool_] | None = None,
    floor_deg: float = 10.0,
) -> NDArray[np.float64]:
    """Move the surface nodes of a body along their normals until it has the given volume.

    A facet whose corners lie on a convex surface cuts a cap off, and the mesher's envelope lets it cut more; over the
    whole surface that is a few tenths of a millimetre. With g_i the volume's derivative by node i, each node moves by
    s g_i / |g_i|, where s is what is missing over the sum of |g_i|. Nodes whose move would spoil an element stay.

    Parameters
    ----------
    nodes, elements
        The mesh, shapes (N, 3) in metres and (M, 4).
    body
        Shape (M,), the elements of the body.
    volume
        Wanted, m^3.
    held
        Shape (N,), nodes that stay; none by default.
    floor_deg
        No element's smallest dihedral angle falls below this, or loses more than a tenth if it lies there already.

    Returns
    -------
    ndarray
        Nodes, shape (N, 3), metres.
    """
    facets = _outward_facets(elements, body)
    movable = np.zeros(len(nodes), dtype=bool)
    movable[facets] = True
    if held is not None:
        movable &= ~held
    near = elements[movable[elements].any(axis=1)]
    lowest = np.minimum(floor_deg, (1.0 - _ANGLE_LOSS) * dihedral_angles_deg(nodes, near).min(axis=1))
    moved = nodes
    for _ in range(_ROUNDS):
        gradient = _volume_gradient(moved, facets)
        size = np.linalg.norm(gradient, axis=1)
        chosen = movable & (size > 0.0)
        if not chosen.any():
            break
        missing = volume - tetrahedron_volumes(moved, elements[body]).sum()
        trial = moved.copy()
        trial[chosen] += missing / size[chosen].sum() * gradient[chosen] / size[chosen, None]
        spoiled = tetrahedron_volumes(trial, near) <= 0.0
        spoiled[~spoiled] |= dihedral_angles_deg(trial, near[~spoiled]).min(axis=1) < lowest[~spoiled]
        if spoiled.any():
            movable[near[spoiled]] = False
            moved = nodes  # the others share what these cannot take, from the start
        else:
            moved = trial
    return moved


def _outward_facets(elements: NDArray[np.int32], body: NDArray[np.bool_]) -> NDArray[np.int32]:
    table = face_table(elements)
    inner = body[table.owners]
    interface = inner[:, 0] != inner[:, 1]
    turned = np.where(inner[interface, :1], table.interior[interface], table.interior[interface, ::-1])
    return np.vstack([turned, table.boundary[body[table.boundary_owner]]])


def _volume_gradient(nodes: NDArray[np.float64], facets: NDArray[np.int32]) -> NDArray[np.float64]:
    """Take the derivative of the enclosed volume by each node, shape (N, 3): a third of the area vectors around it."""
    a, b, c = np.moveaxis(nodes[facets], 1, 0)
    sixth = np.cross(b - a, c - a) / 6.0
    gradient = np.zeros_like(nodes)
    np.add.at(gradient, facets.ravel(), np.repeat(sixth, 3, axis=0))
    return gradient

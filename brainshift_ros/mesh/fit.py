"""Fit a split mesh to its bodies: volumes restored, flat elements repaired, doubled nodes kept together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.improve import GOAL_DEG, raise_angles
from brainshift_ros.mesh.quality import dihedral_angles_deg
from brainshift_ros.mesh.shapes import Shapes
from brainshift_ros.mesh.tetmesh import TetMesh, tetrahedron_volumes
from brainshift_ros.mesh.volume import restore_volume

#: Smallest dihedral angle, degrees, that restoring a volume may leave, round by round; the repair raises what is flat.
FLOORS_DEG = (6.0, 8.0, 11.0)

#: Relative error of a volume that needs no further round.
ENOUGH = 1e-3


def fitted_nodes(mesh: TetMesh, piece: NDArray[np.int32], shapes: Shapes) -> NDArray[np.float64]:
    """Move the nodes of a mesh so that brain and tumour have their volumes and no element is flat.

    Restoring a volume flattens elements and the repair of those changes volumes a little, so both take turns.

    Parameters
    ----------
    mesh
        Split, with named facets and rims.
    piece
        Shape (M,), number of the tumour's piece from 1 that each element belongs to, else 0.
    shapes
        Volumes to restore.

    Returns
    -------
    ndarray
        Nodes, shape (N, 3), metres; copies of a doubled node stay together.
    """
    places, place_of = np.unique(mesh.nodes, axis=0, return_inverse=True)
    place_of = place_of.ravel()
    elements = place_of[mesh.elements].astype(np.int32)
    surfaces = [place_of[facets] for facets in mesh.facets.values()]
    rims = [place_of[ids] for name, ids in mesh.node_sets.items() if name.endswith("_rim")]
    outer = np.zeros(len(places), dtype=bool)
    outer[place_of[mesh.facets["skull"]]] = True
    bodies = [(piece == number, tumor.volume, outer) for number, tumor in enumerate(shapes.tumors, start=1)]
    bodies = [(body, volume, held) for body, volume, held in bodies if body.any()]
    bodies.append((np.ones(len(elements), dtype=bool), shapes.brain_volume, np.zeros(len(places), dtype=bool)))
    for floor_deg in FLOORS_DEG:
        for body, volume, held in bodies:
            places = restore_volume(places, elements, body, volume, held=held, floor_deg=floor_deg)
        places = raise_angles(places, elements, surfaces, rims)
        volumes = tetrahedron_volumes(places, elements)
        missing = max(abs(volumes[body].sum() / volume - 1.0) for body, volume, _ in bodies)
        if missing < ENOUGH and dihedral_angles_deg(places, elements).min() >= GOAL_DEG:
            break
    return places[place_of]

"""Region of each element, and the piece of tumour that it belongs to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.image.resample import sample
from brainshift_ros.image.volume import Region
from brainshift_ros.mesh.shapes import Shapes, filled
from brainshift_ros.mesh.tetmesh import tetrahedron_volumes
from brainshift_ros.septa.sheets import sheet_surfaces
from brainshift_ros.septa.side import side_of_sheet
from brainshift_ros.surface.facets import face_table, facet_areas
from brainshift_ros.surface.queries import closest_points, inside
from brainshift_ros.surface.surface import Surface

#: Within this distance of a sheet, metres, an element's side of it decides, not the label.
_NEAR = 0.01

#: An element straddles the tumour's surface if its centre is this close to it, in edges of a regular one of its volume.
_STRADDLING = 0.12
_ROUNDS = 10


def regions_of(
    nodes: NDArray[np.float64], elements: NDArray[np.int32], shapes: Shapes
) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Decide by the meshed surface for the tumour, by the sheets beside septa, and by the labels elsewhere.

    Parameters
    ----------
    nodes, elements
        The mesh before it is split, shapes (N, 3) in metres and (M, 4).

    Returns
    -------
    region : ndarray
        Shape (M,), :class:`~brainshift_ros.image.volume.Region`.
    piece : ndarray
        Shape (M,), number of the tumour's piece from 1, 0 outside the tumour.
    """
    centres = nodes[elements].mean(axis=1)
    region = sample(filled(shapes.labels), centres, "nearest")
    sheets = sheet_surfaces(shapes.septa)
    if "tentorium" in sheets:
        side = side_of_sheet(sheets["tentorium"], centres)
        beside = (side.overshoot == 0.0) & (np.abs(side.height) < _NEAR) & (region != Region.BRAINSTEM)
        cerebral = sample(filled(shapes.labels, (Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM)), centres, "nearest")
        region[beside & (side.height < 0.0)] = Region.CEREBELLUM
        above = beside & (side.height >= 0.0)
        region[above] = cerebral[above]
    if "falx" in sheets:
        side = side_of_sheet(sheets["falx"], centres)
        beside = (side.overshoot == 0.0) & (np.abs(side.height) < _NEAR)
        beside &= (region == Region.LEFT_CEREBRUM) | (region == Region.RIGHT_CEREBRUM)
        region[beside] = np.where(side.height[beside] >= 0.0, Region.RIGHT_CEREBRUM, Region.LEFT_CEREBRUM)
    piece = np.zeros(len(centres), dtype=np.int32)
    for number, surface in enumerate(shapes.meshed_tumors, start=1):
        piece[(piece == 0) & _within(surface, nodes, elements)] = number
    region[piece > 0] = Region.TUMOR
    return region, piece


def _within(surface: Surface, nodes: NDArray[np.float64], elements: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Elements inside a closed surface: by their centres, but those that straddle it go where they add less surface.

    The mesher follows a surface within its envelope, so a few elements have their centre nearly on it and a corner on
    either side; by the centre alone each would stand out as a tooth.
    """
    centres = nodes[elements].mean(axis=1)
    within = inside(surface, centres)
    near = closest_points(surface, centres).distance < _STRADDLING * np.cbrt(8.5 * tetrahedron_volumes(nodes, elements))
    table = face_table(elements)
    areas = np.repeat(facet_areas(nodes, table.interior), 2)
    for _ in range(_ROUNDS):
        apart = np.repeat(within[table.owners[:, 0]] != within[table.owners[:, 1]], 2)
        gain = np.bincount(table.owners.ravel(), np.where(apart, areas, -areas), minlength=len(elements))
        turned = near & (gain > 0.0)
        if not turned.any():
            break
        within = within ^ turned
    return within

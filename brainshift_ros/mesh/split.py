"""Split a mesh along dural septa: nodes on the sheets are doubled, the free inner edge stays joined (spec P5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.facets import FaceTable, components, face_table
from brainshift_ros.mesh.sheets import Septum
from brainshift_ros.mesh.side import merged, side_of_sheet
from brainshift_ros.mesh.surface import Surface

#: How far past a sheet's edge the centre of a mesh face may lie and still be cut, metres.
EDGE_TOLERANCE_M = 0.001


@dataclass(frozen=True)
class SplitMesh:
    """Result of a split.

    Attributes
    ----------
    nodes
        Shape (N', 3), metres; the first N are those of the mesh before.
    elements
        Shape (M, 4), in the order of the mesh before.
    facets
        For each sheet name the facets of *both* sides, each pointing out of its element.
    rims
        For each sheet name the nodes of its free edge, which both sides share.
    """

    nodes: NDArray[np.float64]
    elements: NDArray[np.int32]
    facets: Mapping[str, NDArray[np.int32]]
    rims: Mapping[str, NDArray[np.int32]]


def sheet_surfaces(septa: Sequence[Septum]) -> dict[str, Surface]:
    """One surface a name: left and right tentorium become one roof."""
    names = list(dict.fromkeys(septum.name for septum in septa))
    return {name: merged([s.surface for s in septa if s.name == name]) for name in names}


def split_along_septa(nodes: NDArray[np.float64], elements: NDArray[np.int32], septa: Sequence[Septum]) -> SplitMesh:
    """Split a mesh whose faces follow the septa.

    A face is cut where its two elements lie on opposite sides of a sheet and its centre lies beside the sheet. Such a
    cut has no holes, whatever the mesher did: it bounds a set of elements. Each node on a cut is then given one copy
    for each group of its elements that uncut faces connect. Around a free edge all elements stay connected, so the edge
    keeps one copy; on a sheet there are two, three where falx meets tentorium.

    Parameters
    ----------
    nodes
        Shape (N, 3), metres.
    elements
        Shape (M, 4).
    septa
        Sheets that reach beyond the mesh where they are attached.
    """
    table = face_table(elements)
    cut_by = _cut_faces(nodes, elements, table, sheet_surfaces(septa))
    cut = np.zeros(len(table.interior), dtype=bool)
    for faces in cut_by.values():
        cut |= faces
    new_nodes, new_elements = _double_nodes(nodes, elements, table, cut)
    facets, rims = {}, {}
    outer = np.unique(table.boundary)
    for name, faces in cut_by.items():
        facets[name] = _both_sides(table, faces, elements, new_elements)
        rims[name] = _rim(table.interior[faces], outer)
    return SplitMesh(new_nodes, new_elements, facets, rims)


def _cut_faces(
    nodes: NDArray[np.float64], elements: NDArray[np.int32], table: FaceTable, sheets: Mapping[str, Surface]
) -> dict[str, NDArray[np.bool_]]:
    centres = nodes[elements].mean(axis=1)
    face_centres = nodes[table.interior].mean(axis=1)
    cut_by: dict[str, NDArray[np.bool_]] = {}
    taken = np.zeros(len(table.interior), dtype=bool)
    for name, surface in sheets.items():
        side = side_of_sheet(surface, centres).height >= 0.0
        beside = side_of_sheet(surface, face_centres).overshoot <= EDGE_TOLERANCE_M
        side = _without_pockets(side, beside, table)
        cut = (side[table.owners[:, 0]] != side[table.owners[:, 1]]) & beside & ~taken
        cut_by[name] = cut
        taken |= cut
    return cut_by


def _without_pockets(side: NDArray[np.bool_], beside: NDArray[np.bool_], table: FaceTable) -> NDArray[np.bool_]:
    """Turn elements to the other side that a cut would isolate from all the rest."""
    side = side.copy()
    while True:
        cut = (side[table.owners[:, 0]] != side[table.owners[:, 1]]) & beside
        part = components(len(side), table.owners[~cut])
        pocket = part != np.argmax(np.bincount(part))
        if not pocket.any():
            return side
        # A pocket that is nearly half of the mesh is no pocket: the sheet parts the mesh, which the gate then refuses.
        if np.count_nonzero(pocket) > 0.02 * len(side):
            return side
        side[pocket] = ~side[pocket]


def _double_nodes(
    nodes: NDArray[np.float64], elements: NDArray[np.int32], table: FaceTable, cut: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    on_cut = np.zeros(len(nodes), dtype=bool)
    on_cut[table.interior[cut].ravel()] = True
    # Corners are (element, local vertex) pairs; uncut faces join the corners of their two elements at shared nodes.
    corner = np.arange(elements.size).reshape(elements.shape)
    joined = table.owners[~cut]
    near = on_cut[table.interior[~cut]].any(axis=1)
    joined, faces = joined[near], table.interior[~cut][near]
    pairs = []
    for k in range(3):
        node = faces[:, k]
        keep = on_cut[node]
        ends = [corner[e, np.argmax(elements[e] == node[keep][:, None], axis=1)] for e in (joined[keep, 0], joined[keep, 1])]
        pairs.append(np.stack(ends, axis=1))
    group = components(elements.size, np.vstack(pairs))
    flat = elements.ravel()
    cut_corners = np.flatnonzero(on_cut[flat])
    copies, copy_of = np.unique(np.stack([flat[cut_corners], group[cut_corners]], axis=1), axis=0, return_inverse=True)
    first = np.concatenate([[True], copies[1:, 0] != copies[:-1, 0]])
    ids = np.where(first, copies[:, 0], len(nodes) + np.cumsum(~first) - 1)
    new_elements = flat.copy()
    new_elements[cut_corners] = ids[copy_of.ravel()]
    return np.vstack([nodes, nodes[copies[~first, 0]]]), new_elements.reshape(elements.shape).astype(np.int32)


def _both_sides(
    table: FaceTable, cut: NDArray[np.bool_], elements: NDArray[np.int32], new_elements: NDArray[np.int32]
) -> NDArray[np.int32]:
    sides = []
    for side, turned in ((0, slice(None)), (1, slice(None, None, -1))):
        owner = table.owners[cut, side]
        local = np.argmax(elements[owner][:, None, :] == table.interior[cut][:, turned][:, :, None], axis=2)
        sides.append(np.take_along_axis(new_elements[owner], local, axis=1))
    return np.vstack(sides).astype(np.int32)


def _rim(faces: NDArray[np.int32], outer: NDArray) -> NDArray[np.int32]:
    """Nodes of edges that belong to one cut face only and do not lie on the outer boundary."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    free = unique[count == 1]
    free = free[~np.isin(free, outer).all(axis=1)]
    return np.unique(free).astype(np.int32)

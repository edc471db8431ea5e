"""Split a mesh along dural septa: nodes on the sheets are doubled, the free inner edge stays joined (spec P5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.septa.sheets import Septum, sheet_surfaces
from brainshift_ros.septa.side import side_of_sheet
from brainshift_ros.surface.facets import FaceTable, components, face_table, facet_areas
from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surface import Surface

#: How far past a sheet's edge the centre of a mesh face may lie and still be cut, metres.
EDGE_TOLERANCE_M = 0.001

#: The same where falx meets tentorium: meshed, the two may meet that far from the straight sinus.
JUNCTION_REACH_M = 0.005

#: How far from a sheet the centre of an element may lie and still be counted to the other side, metres.
SHEET_TOLERANCE_M = 0.001

#: Pockets hold less than this share of all elements; turning one rarely leaves another, never as many as this in a row.
_LARGEST_POCKET, _POCKET_PASSES = 0.02, 20


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
        For each sheet name the facets of *both* sides, each pointing out of its element: first all of the side that
        the sheet's normals leave (left of the falx, under the tentorium), then, in the same order, those opposite.
    rims
        For each sheet name the nodes of its free edge, which both sides share.
    """

    nodes: NDArray[np.float64]
    elements: NDArray[np.int32]
    facets: Mapping[str, NDArray[np.int32]]
    rims: Mapping[str, NDArray[np.int32]]


def split_along_septa(
    nodes: NDArray[np.float64],
    elements: NDArray[np.int32],
    septa: Sequence[Septum],
    uncut: NDArray[np.bool_] | None = None,
) -> SplitMesh:
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
    uncut
        Shape (M,), elements that stay joined to each other across a sheet: tumour that grew through it.
    """
    table = face_table(elements)
    whole = np.zeros(len(elements), dtype=bool) if uncut is None else uncut
    may_be_cut = ~(whole[table.owners[:, 0]] & whole[table.owners[:, 1]])
    cut_by = _cut_faces(nodes, elements, table, sheet_surfaces(septa), may_be_cut)
    every_cut = np.concatenate([np.empty(0, dtype=np.int64), *(cut.faces for cut in cut_by.values())])
    if len(every_cut) == 0:
        empty = np.empty((0, 3), dtype=np.int32)
        return SplitMesh(nodes, elements, dict.fromkeys(cut_by, empty), dict.fromkeys(cut_by, empty[:, 0]))
    new_nodes, new_elements = _double_nodes(nodes, elements, table, every_cut)
    facets, rims = {}, {}
    for name, cut in cut_by.items():
        below, above = (
            _facets_of(table.interior[cut.faces], owner, elements, new_elements) for owner in (cut.below, cut.above)
        )
        outward = table.owners[cut.faces, 0] == cut.below
        below, above = _turned(below, ~outward), _turned(above, outward)
        # A lone facet at a sheet's tip, with all its nodes on the free edge, parts nothing.
        parted = np.any(np.sort(below, axis=1) != np.sort(above, axis=1), axis=1)
        facets[name] = np.vstack([below[parted], above[parted]])
        rims[name] = rim_nodes(below[parted], above[parted])
    return SplitMesh(new_nodes, new_elements, facets, rims)


@dataclass(frozen=True)
class _Cut:
    """Faces, as rows of the face table's interior faces, and the elements below and above each."""

    faces: NDArray[np.int64]
    below: NDArray[np.int64]
    above: NDArray[np.int64]


def _cut_faces(
    nodes: NDArray[np.float64],
    elements: NDArray[np.int32],
    table: FaceTable,
    sheets: Mapping[str, Surface],
    may_be_cut: NDArray[np.bool_],
) -> dict[str, _Cut]:
    """Choose the faces that each sheet cuts among those, shape (F,) of the interior ones, that may be."""
    centres = nodes[elements].mean(axis=1)
    face_centres = nodes[table.interior].mean(axis=1)
    areas = facet_areas(nodes, table.interior)
    cuts: dict[str, _Cut] = {}
    open_, parted = may_be_cut.copy(), np.zeros(len(table.interior), dtype=bool)
    # The falx stands on the tentorium: it goes down to it, takes none of its faces, and none between elements below it.
    roof: Surface | None = None
    for name in sorted(sheets, key=("tentorium", "falx").index):
        located = side_of_sheet(sheets[name], centres)
        beside = open_ & _beside(sheets[name], roof, face_centres)
        side = _smoothed(located.height, beside, areas, table)
        side = _without_pockets(side, beside, parted, table)
        first, second = side[table.owners].T
        faces = np.flatnonzero((first != second) & beside)
        one, two = table.owners[faces].T
        cuts[name] = _Cut(faces, np.where(side[one], two, one), np.where(side[one], one, two))
        roof, below = sheets[name], ~side & (located.overshoot == 0.0)
        parted[faces] = True
        open_ &= ~(parted | below[table.owners].all(axis=1))
    return {name: cuts[name] for name in sheets}


def _beside(sheet: Surface, roof: Surface | None, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which points, shape (n, 3), lie beside a sheet, or just past its edge where it stands on a roof."""
    located = side_of_sheet(sheet, points)
    beside = located.overshoot <= EDGE_TOLERANCE_M
    if roof is not None:
        past = np.flatnonzero(~beside & (located.overshoot <= JUNCTION_REACH_M))
        on_roof = closest_points(roof, located.closest[past]).distance < EDGE_TOLERANCE_M
        beside[past] = on_roof & (side_of_sheet(roof, points[past]).overshoot == 0.0)
    return beside


def _smoothed(
    height: NDArray[np.float64], beside: NDArray[np.bool_], areas: NDArray[np.float64], table: FaceTable
) -> NDArray[np.bool_]:
    """Side of each element: that of its centre, but for elements right at the sheet, which take the side that cuts less.

    The mesher leaves elements whose faces straddle the sheet; without this the cut would run around each, and its rims
    would have single facets for teeth.
    """
    side = height >= 0.0
    owners, areas = table.owners[beside], areas[beside]
    for _ in range(10):
        cut = side[owners[:, 0]] != side[owners[:, 1]]
        gain = np.bincount(owners.ravel(), np.repeat(np.where(cut, areas, -areas), 2), minlength=len(side))
        straddles = np.bincount(owners[cut].ravel(), minlength=len(side)) > 1
        turn = straddles & (gain > 0.0) & (np.abs(height) < SHEET_TOLERANCE_M)
        if not turn.any():
            break
        side = side ^ turn
    return side


def _without_pockets(
    side: NDArray[np.bool_], beside: NDArray[np.bool_], parted: NDArray[np.bool_], table: FaceTable
) -> NDArray[np.bool_]:
    """Turn elements to the other side that a cut, with the faces parted before, would isolate from all the rest."""
    side = side.copy()
    for _ in range(_POCKET_PASSES):
        cut = (side[table.owners[:, 0]] != side[table.owners[:, 1]]) & beside
        part = components(len(side), table.owners[~(cut | parted)])
        pocket = part != np.argmax(np.bincount(part))
        # A pocket that is nearly half of the mesh is no pocket: the sheet parts the mesh, which the gate then refuses.
        if not pocket.any() or np.count_nonzero(pocket) > _LARGEST_POCKET * len(side):
            break
        side[pocket] = ~side[pocket]
    return side


def _double_nodes(
    nodes: NDArray[np.float64], elements: NDArray[np.int32], table: FaceTable, cut_faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    cut = np.zeros(len(table.interior), dtype=bool)
    cut[cut_faces] = True
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


def _facets_of(
    faces: NDArray[np.int32], owner: NDArray[np.int64], elements: NDArray[np.int32], new_elements: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Faces, given by the nodes before, with the copies of their nodes that their owner uses."""
    local = np.argmax(elements[owner][:, None, :] == faces[:, :, None], axis=2)
    return np.take_along_axis(new_elements[owner], local, axis=1).astype(np.int32)


def _turned(faces: NDArray[np.int32], turn: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.where(turn[:, None], faces[:, ::-1], faces)


def rim_nodes(below: NDArray[np.int32], above: NDArray[np.int32]) -> NDArray[np.int32]:
    """Nodes of the edges that both sides of a sheet share: there it ends inside the tissue.

    Where it ends on the skull or on another sheet, each side has its own copies.
    """
    edges = [np.unique(np.sort(side[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0) for side in (below, above)]
    both, count = np.unique(np.vstack(edges), axis=0, return_counts=True)
    return np.unique(both[count == 2]).astype(np.int32)

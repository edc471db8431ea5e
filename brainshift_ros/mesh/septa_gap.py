"""How well split septa reach the skull and each other: the gaps along their attached edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.surface.queries import closest_points, inside
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm

_STEP_M = 0.001


def gap_figures(mesh: TetMesh, septa: Sequence[Septum]) -> dict[str, float]:
    """Measure the gaps that a mesh leaves between septa and skull, and between falx and tentorium.

    Every edge of a split sheet's border lies on the skull, on the other sheet, or inside the tissue. Of those inside, the
    ones nearest to the given sheet's free edge, and those on a tumour that grew through, are where it should end. The others
    are gaps, as wide as their midpoint is far from the skull or, along the straight sinus, from the tentorium.

    Parameters
    ----------
    mesh
        Split along the septa.
    septa
        The sheets that it was split along.

    Returns
    -------
    dict
        For falx and tentorium ``<name>_gap_mm_mean`` and ``<name>_gap_mm_max`` along the attached edge, closed or not, and
        ``<name>_closed_percent``, the share of its length without a gap; the same for the falx-tentorium ``junction``.
        What the mesh does not have is left out.
    """
    skull = Surface(mesh.nodes, mesh.facets["skull"])
    on_skull, on_tumor = np.zeros((2, len(mesh.nodes)), dtype=bool)
    on_skull[skull.faces] = True
    on_tumor[mesh.facets.get("tumor", np.empty((0, 3), dtype=np.int32))] = True
    figures: dict[str, float] = {}
    for name in ("falx", "tentorium"):
        if len(mesh.facets.get(name, ())) == 0:
            continue
        edges, parted = _border(*np.split(mesh.facets[name], 2))
        kept = parted | ~on_tumor[edges].all(axis=1)
        edges, parted = edges[kept], parted[kept]
        length = np.linalg.norm(mesh.nodes[edges[:, 0]] - mesh.nodes[edges[:, 1]], axis=1)
        middle = mesh.nodes[edges].mean(axis=1)
        part = _edge_of_sheet(septa, name, skull).nearest(middle)
        at_skull = on_skull[edges].all(axis=1)
        depth = np.where(at_skull, 0.0, closest_points(skull, middle).distance)
        attached = at_skull | (~parted & (part == 0))
        figures |= _summary(name, depth[attached], length[attached])
        if name == "falx" and len(mesh.facets.get("tentorium", ())):
            roof = Surface(mesh.nodes, mesh.facets["tentorium"])
            height = np.where(parted, 0.0, closest_points(roof, middle).distance)
            joint = ~at_skull & (parted | (part == 2))
            figures |= _summary("junction", height[joint], length[joint])
    return figures


def _summary(name: str, gap: NDArray[np.float64], length: NDArray[np.float64]) -> dict[str, float]:
    if len(gap) == 0:
        return {}
    return {
        f"{name}_gap_mm_mean": float(m_to_mm(np.average(gap, weights=length))),
        f"{name}_gap_mm_max": float(m_to_mm(gap.max())),
        f"{name}_closed_percent": float(100.0 * length[gap == 0.0].sum() / length.sum()),
    }


def _border(one: NDArray[np.int32], other: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Border edges, shape (n, 2), of one side of a sheet, and whether the two sides have come apart there."""
    edges = _border_edges(one)
    joined = {tuple(edge) for edge in _edges(other).tolist()}
    return edges, np.array([tuple(edge) not in joined for edge in edges.tolist()], dtype=bool)


def _edges(faces: NDArray) -> NDArray:
    return np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)


def _border_edges(faces: NDArray) -> NDArray:
    edges, count = np.unique(_edges(faces), axis=0, return_counts=True)
    return edges[count == 1]


@dataclass(frozen=True)
class _EdgeOfSheet:
    """Points, each of shape (n, 3), along a septum's border: attached or outside the brain, free, and shared with others."""

    attached: NDArray[np.float64]
    free: NDArray[np.float64]
    shared: NDArray[np.float64]

    def nearest(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
        """Tell which part, 0 to 2 in the order of the attributes, is nearest to each point, shape (n, 3)."""
        parts = (self.attached, self.free, self.shared)
        distances = [cKDTree(part).query(points)[0] if len(part) else np.full(len(points), np.inf) for part in parts]
        return np.argmin(distances, axis=0)


def _edge_of_sheet(septa: Sequence[Septum], name: str, skull: Surface) -> _EdgeOfSheet:
    parts: tuple[list[NDArray[np.float64]], ...] = ([], [], [])
    others = [septum.surface.vertices for septum in septa if septum.name != name]
    for septum in (septum for septum in septa if septum.name == name):
        vertices, edges = septum.surface.vertices, _border_edges(septum.surface.faces)
        attached = ~inside(skull, vertices)
        attached[septum.attached] = True
        shared = np.zeros(len(vertices), dtype=bool)
        if others:
            shared = cKDTree(np.vstack(others)).query(vertices)[0] < 1e-7
        kind = np.where(attached[edges].all(axis=1), 0, np.where(shared[edges].all(axis=1), 2, 1))
        for k, part in enumerate(parts):
            part.append(_sampled(vertices[edges[kind == k]]))
    return _EdgeOfSheet(*(np.vstack(part) for part in parts))


def _sampled(segments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points, shape (m, 3), a millimetre apart or less along segments of shape (n, 2, 3)."""
    if len(segments) == 0:
        return np.empty((0, 3))
    start, end = segments[:, 0], segments[:, 1]
    count = int(np.ceil(np.linalg.norm(end - start, axis=1).max() / _STEP_M)) + 1
    along = np.linspace(0.0, 1.0, count)[:, None]
    return (start[:, None] + along * (end - start)[:, None]).reshape(-1, 3)

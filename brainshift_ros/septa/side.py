"""On which side of an open sheet a point lies, and whether it is beside the sheet at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import vertex_normals


@dataclass(frozen=True)
class SideOfSheet:
    """Where points lie relative to a sheet.

    Attributes
    ----------
    height
        Shape (n,), metres, along the sheet's normal; its sign is the side.
    overshoot
        Shape (n,), metres by which a point lies past the sheet's edge; zero for points beside the sheet.
    closest
        Shape (n, 3), metres, the sheet's point closest to each.
    """

    height: NDArray[np.float64]
    overshoot: NDArray[np.float64]
    closest: NDArray[np.float64]


def side_of_sheet(sheet: Surface, points: NDArray[np.float64]) -> SideOfSheet:
    """Locate points, shape (n, 3), relative to the closest point of a sheet.

    The normal at the closest point is interpolated from the vertices (area weighted), so a closest point on an edge or
    a ridge has one too (Baerentzen and Aanaes 2005).
    """
    found = closest_points(sheet, points)
    weights, corners = found.barycentric, sheet.faces[found.face]
    normals = np.einsum("ni,nik->nk", weights, vertex_normals(sheet.vertices, sheet.faces)[corners])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offset = points - found.position
    height = np.einsum("nk,nk->n", offset, normals)
    at_edge = _on_edge(sheet)[corners]
    # the closest point is on the sheet's edge if every corner that carries weight is
    past = np.all(at_edge | (weights < 1e-3), axis=1)
    overshoot = np.where(past, np.sqrt(np.maximum(np.einsum("nk,nk->n", offset, offset) - height**2, 0.0)), 0.0)
    return SideOfSheet(height, overshoot, found.position)


def _on_edge(sheet: Surface) -> NDArray[np.bool_]:
    edges = np.sort(sheet.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    on_edge = np.zeros(len(sheet.vertices), dtype=bool)
    on_edge[unique[count == 1].ravel()] = True
    return on_edge

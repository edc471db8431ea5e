"""How long an edge should be where, and how many nodes that gives (spec P4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from brainshift_ros.mesh.queries import closest_points, inside
from brainshift_ros.mesh.surface import Surface

#: Edge length at the tumour's surface, relative to that far away, and the distance over which it grows.
TUMOR_REFINEMENT = 0.6
TUMOR_REACH_M = 0.03

#: Elements outside the brain are thrown away; their edges grow by this much per metre of distance from it.
OUTSIDE_GROWTH = 1.0

#: No target edge is longer than this many times that far from the tumour: the mesher's box grows with it.
LARGEST_EDGE = 3.0

# Nodes per edge-cubed of volume and per edge-squared of surface, fitted to meshes of the template with septa.
_NODES_PER_VOLUME, _NODES_PER_SURFACE = 1.48, 5.2

# A Kuhn cube: six tetrahedra around the diagonal from corner 0 to corner 7; corner i + 2j + 4k.
_KUHN = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])


@dataclass(frozen=True)
class SizeField:
    """Target edge length on a coarse background mesh.

    Attributes
    ----------
    points
        Shape (n, 3), metres.
    tetrahedra
        Shape (m, 4), positive.
    edge
        Shape (n,), metres.
    """

    points: NDArray[np.float64]
    tetrahedra: NDArray[np.int32]
    edge: NDArray[np.float64]


def relative_edge(points: NDArray[np.float64], tumor: Surface | None) -> NDArray[np.float64]:
    """Edge length relative to that far from the tumour, shape (n,): :data:`TUMOR_REFINEMENT` on and in it, growing to 1."""
    if tumor is None:
        return np.ones(len(points))
    inner = tumor.vertices.mean(axis=0)
    radius = np.linalg.norm(tumor.vertices - inner, axis=1).mean()
    distance = np.where(
        np.linalg.norm(points - inner, axis=1) < radius, 0.0, cKDTree(tumor.vertices).query(points, workers=1)[0]
    )
    return TUMOR_REFINEMENT + (1.0 - TUMOR_REFINEMENT) * np.clip(distance / TUMOR_REACH_M, 0.0, 1.0)


def size_field(brain: Surface, tumor: Surface | None, edge_length: float, spacing: float = 0.012) -> SizeField:
    """Target edge lengths over a box around the brain, on a grid of `spacing` metres."""
    # The mesher's box lies one longest edge outside the surfaces; septa stand out of the brain a little.
    margin = LARGEST_EDGE * edge_length + 0.02
    low, high = brain.vertices.min(axis=0) - margin, brain.vertices.max(axis=0) + margin
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    outside = np.where(inside(brain, points), 0.0, closest_points(brain, points).distance)
    edge = edge_length * relative_edge(points, tumor) + OUTSIDE_GROWTH * outside
    edge = np.minimum(edge, LARGEST_EDGE * edge_length)
    return SizeField(points, _kuhn_tetrahedra(tuple(len(a) for a in axes)), edge)


def edge_length_for(nodes: int, brain: Surface, tumor: Surface | None) -> float:
    """Edge length, far from the tumour, that gives about this many nodes, metres.

    With V the integral of the relative edge length to the power -3 over the brain, a mesh of edge h holds about
    ``1.48 V / h^3 + 5.2 V^(2/3) / h^2`` nodes, the second term for the surface and the doubled nodes of the septa.
    """
    spacing = 0.004
    axes = [np.arange(a, b, spacing) for a, b in zip(brain.vertices.min(axis=0), brain.vertices.max(axis=0), strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = points[inside(brain, points)]
    volume = spacing**3 * np.sum(relative_edge(points, tumor) ** -3.0)

    def surplus(edge: float) -> float:
        return _NODES_PER_VOLUME * volume / edge**3 + _NODES_PER_SURFACE * volume ** (2 / 3) / edge**2 - nodes

    return float(brentq(surplus, 1e-4, 0.1))


def _kuhn_tetrahedra(counts: tuple[int, ...]) -> NDArray[np.int32]:
    ids = np.arange(np.prod(counts)).reshape(counts)
    i_end, j_end, k_end = (count - 1 for count in counts)
    offsets = [(i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    corners = [ids[i : i_end + i, j : j_end + j, k : k_end + k] for i, j, k in offsets]
    cubes = np.stack([c.ravel() for c in corners], axis=1)
    return cubes[:, _KUHN].reshape(-1, 4).astype(np.int32)

"""How long an edge should be where, and how many nodes that gives (spec P4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from brainshift_ros.surface.queries import closest_points, inside
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import enclosed_volume, face_areas

#: Edge length in and at a tumour, and under the craniotomy, relative to that far away.
TUMOR_REFINEMENT, CRANIOTOMY_REFINEMENT = 0.6, 0.7

#: From there it grows by this much, relative to that far away, per metre of distance: from 0.6 to 1 over 30 mm.
GROWTH_PER_M = 0.4 / 0.03

#: Edges of a small or thin tumour are at most this share of its radius (three times volume by area), down to the least.
TUMOR_RESOLUTION, LEAST_REFINEMENT = 0.8, 0.25

#: Elements outside the brain are thrown away; their edges grow by this much per metre of distance from it.
OUTSIDE_GROWTH = 1.0

#: No target edge is longer than this many times that far from the tumour: the mesher's box grows with it.
LARGEST_EDGE = 3.0

#: Finest and coarsest grid for target edge lengths, metres.
GRID_SPACING_M = (0.006, 0.012)

# Nodes per edge-cubed of volume and per edge-squared of surface, fitted to meshes of the template with septa.
_NODES_PER_VOLUME, _NODES_PER_SURFACE = 1.24, 10.0

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


@dataclass(frozen=True)
class Craniotomy:
    """The opening of the skull as a ball: a point on or near the cortex, shape (3,), and a radius, metres."""

    center: NDArray[np.float64]
    radius: float


class EdgeLengths:
    """Target edge lengths at given points: short near each tumour and the craniotomy, growing with the distance.

    Parameters
    ----------
    points
        Shape (n, 3), metres.
    tumors
        Closed surfaces.
    craniotomy
        None if it is not known.
    """

    def __init__(self, points: NDArray[np.float64], tumors: Sequence[Surface], craniotomy: Craniotomy | None) -> None:
        self._count = len(points)
        self._radii = [effective_radius(tumor) for tumor in tumors]
        self._from_tumor = [distance_to_body(tumor, points) for tumor in tumors]
        self._from_opening = None
        if craniotomy is not None:
            self._from_opening = np.maximum(np.linalg.norm(points - craniotomy.center, axis=1) - craniotomy.radius, 0.0)

    def __call__(self, edge_length: float) -> NDArray[np.float64]:
        """Edge lengths, shape (n,), metres, where they are `edge_length` far from tumour and craniotomy."""
        relative = np.ones(self._count)
        for radius, distance in zip(self._radii, self._from_tumor, strict=True):
            resolved = np.clip(TUMOR_RESOLUTION * radius / edge_length, LEAST_REFINEMENT, TUMOR_REFINEMENT)
            relative = np.minimum(relative, resolved + GROWTH_PER_M * distance)
        if self._from_opening is not None:
            relative = np.minimum(relative, CRANIOTOMY_REFINEMENT + GROWTH_PER_M * self._from_opening)
        return edge_length * relative


def effective_radius(body: Surface) -> float:
    """Three times volume by area, metres: a ball's radius; half as much again as a plate's thickness."""
    return 3.0 * abs(enclosed_volume(body)) / float(face_areas(body).sum())


def distance_to_body(body: Surface, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of points, shape (n, 3), to a closed surface, zero inside; metres."""
    return np.where(inside(body, points), 0.0, closest_points(body, points).distance)


def size_field(
    brain: Surface,
    tumors: Sequence[Surface],
    edge_length: float,
    craniotomy: Craniotomy | None = None,
) -> SizeField:
    """Target edge lengths over a box around the brain, on a grid that does not step over a small tumour."""
    spacing = float(np.clip(min([effective_radius(tumor) for tumor in tumors], default=np.inf), *GRID_SPACING_M))
    # The mesher's box lies one longest edge outside the surfaces; septa stand out of the brain a little.
    margin = LARGEST_EDGE * edge_length + 0.02
    low, high = brain.vertices.min(axis=0) - margin, brain.vertices.max(axis=0) + margin
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    edge = EdgeLengths(points, tumors, craniotomy)(edge_length) + OUTSIDE_GROWTH * distance_to_body(brain, points)
    edge = np.minimum(edge, LARGEST_EDGE * edge_length)
    return SizeField(points, _kuhn_tetrahedra(tuple(len(a) for a in axes)), edge)


def edge_length_for(nodes: int, brain: Surface, tumors: Sequence[Surface], craniotomy: Craniotomy | None = None) -> float:
    """Edge length, far from tumour and craniotomy, that gives about this many nodes, metres.

    With V the integral of the relative edge length to the power -3 over the brain, a mesh of edge h holds about
    ``1.24 V / h^3 + 10 V^(2/3) / h^2`` nodes, the second term for the surface and the doubled nodes of the septa.
    """
    spacing = 0.004
    axes = [np.arange(a, b, spacing) for a, b in zip(brain.vertices.min(axis=0), brain.vertices.max(axis=0), strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    lengths = EdgeLengths(points[inside(brain, points)], tumors, craniotomy)

    def surplus(edge: float) -> float:
        per_edge_cubed = spacing**3 * float(np.sum(lengths(edge) ** -3.0))
        volume = per_edge_cubed * edge**3
        return _NODES_PER_VOLUME * per_edge_cubed + _NODES_PER_SURFACE * volume ** (2 / 3) / edge**2 - nodes

    return float(brentq(surplus, 1e-4, 0.1))


def _kuhn_tetrahedra(counts: tuple[int, ...]) -> NDArray[np.int32]:
    ids = np.arange(np.prod(counts)).reshape(counts)
    i_end, j_end, k_end = (count - 1 for count in counts)
    offsets = [(i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    corners = [ids[i : i_end + i, j : j_end + j, k : k_end + k] for i, j, k in offsets]
    cubes = np.stack([c.ravel() for c in corners], axis=1)
    return cubes[:, _KUHN].reshape(-1, 4).astype(np.int32)

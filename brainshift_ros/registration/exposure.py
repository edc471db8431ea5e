"""Which points of a surface can be seen from outside it: height maps along many directions (shadow maps, Williams 1978).

Rays would do the same with exact triangles, in several times the time, which a restarted node has not; at the resolution
that registration needs, the two agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import tangent_frame
from brainshift_ros.surface.surface import Surface

_CELL_M = 1.2e-3  # of the height maps
_GRAZING = 0.1  # cosine between direction and normal below which a point counts as hidden
_CLEARANCE_M = 0.5e-3


def open_fraction(
    surface: Surface, points: NDArray[np.float64], normals: NDArray[np.float64], directions: int = 24
) -> NDArray[np.float64]:
    """Share of all directions in which a ray from each point leaves without meeting the surface.

    Parameters
    ----------
    surface
        What hides the points, metres.
    points, normals
        Shape (n, 3), on the surface, metres; outward unit normals.
    directions
        How many directions, evenly over the sphere.

    Returns
    -------
    fraction
        Shape (n,), 0 to about 0.5.

    Notes
    -----
    Along each direction the surface's greatest height in every cell of 1.2 mm is found; a point is open when nothing in its
    cell rises higher above it than its own slope does within one cell.
    """
    # Coordinates by rows, so that each step runs through contiguous memory.
    surface_xyz, points_xyz = (np.ascontiguousarray(at.T) for at in (covering_samples(surface, _CELL_M), points))
    open_count = np.zeros(len(points))
    for direction in sphere_directions(directions):
        axes = tangent_frame(direction)[:2]
        low = (axes @ surface_xyz).min(axis=1)
        shape = tuple(((axes @ surface_xyz).max(axis=1) - low) // _CELL_M + 1)
        heights = np.full(int(np.prod(shape)), -np.inf)
        np.maximum.at(heights, _cells(axes @ surface_xyz, low, shape), direction @ surface_xyz)

        cosine = normals @ direction
        facing = np.flatnonzero(cosine > _GRAZING)
        asked = points_xyz[:, facing]
        cosine = np.minimum(cosine[facing], 1.0)
        rise = np.sqrt(2.0) * _CELL_M * np.sqrt(1.0 - cosine**2) / cosine
        open_count[facing] += heights[_cells(axes @ asked, low, shape)] - direction @ asked < rise + _CLEARANCE_M
    return open_count / directions


def _cells(across: NDArray[np.float64], low: NDArray[np.float64], shape: tuple[float, ...]) -> NDArray[np.int32]:
    """Cell number of each column of `across`, shape (2, n); points just outside the map fall into its border."""
    row, column = ((across - low[:, None]) / _CELL_M).astype(np.int32)
    last_row, last_column = int(shape[0]) - 1, int(shape[1]) - 1
    cells: NDArray[np.int32] = np.clip(row, 0, last_row) * (last_column + 1) + np.clip(column, 0, last_column)
    return cells


def sphere_directions(count: int) -> NDArray[np.float64]:
    """Fibonacci sphere: `count` nearly even unit vectors, shape (count, 3)."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=-1)


def covering_samples(surface: Surface, cell_m: float) -> NDArray[np.float64]:
    """Points on a surface, shape (n, 3), that leave no cell of a map of it empty.

    Each triangle is split evenly until its edges are shorter than 1.5 cells; corners and centres of the parts then cover the
    plane with discs of half a cell.
    """
    corners = surface.vertices[surface.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(np.ceil(longest / (1.5 * cell_m)).astype(int), 1)
    found = [surface.vertices]
    for part in np.unique(parts):
        weights = _lattice(int(part)) if part > 1 else np.full((1, 3), 1.0 / 3.0)
        found.append(np.einsum("sk,fkx->fsx", weights, corners[parts == part]).reshape(-1, 3))
    return np.concatenate(found)


def _lattice(parts: int) -> NDArray[np.float64]:
    """Barycentric coordinates (n, 3) of the corners and centres of a triangle's parts, upright and inverted ones."""
    first, second = np.indices((parts + 1, parts + 1)).reshape(2, -1)
    steps = np.concatenate([np.stack([first + shift, second + shift], axis=-1) for shift in (0.0, 1.0 / 3.0, 2.0 / 3.0)])
    steps = steps[steps.sum(axis=1) < parts + 1e-9]
    return np.column_stack([steps, parts - steps.sum(axis=1)]) / parts

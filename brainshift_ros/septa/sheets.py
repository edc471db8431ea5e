"""Dural septa as triangle sheets: landmarks on the edges and on the sheet, a thin-plate spline between (spec P5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from matplotlib.path import Path as Polygon
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial import Delaunay

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import tangent_frame
from brainshift_ros.image.landmarks import SeptaLandmarks
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import merged
from brainshift_ros.units import mm_to_m

SeptumName = Literal["falx", "tentorium"]

#: Falx and tentorium are larger, and smaller, than this from end to end.
_SMALLEST_MM, _LARGEST_MM = 30.0, 400.0


@dataclass(frozen=True)
class Septum:
    """A dural sheet that divides the brain; falx or one side of the tentorium.

    Attributes
    ----------
    name
        The facet set that its two sides go to.
    surface
        Open triangle sheet that reaches beyond the brain where it is attached to the skull. The falx's normals point
        right, the tentorium's up.
    attached
        Shape (n,), vertices along the edge that is attached to the skull, in order from the torcula forward; empty where
        that is not known.
    """

    name: SeptumName
    surface: Surface
    attached: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, dtype=np.int32))


def sheet_surfaces(septa: Sequence[Septum]) -> dict[str, Surface]:
    """One surface a name: left and right tentorium become one roof."""
    names = list(dict.fromkeys(septum.name for septum in septa))
    return {name: merged([s.surface for s in septa if s.name == name]) for name in names}


def septa_spacing_mm(nodes: int) -> float:
    """Distance between the vertices of a sheet that suits a mesh of so many nodes: about its edge length, 5 mm at 20,000."""
    return float(5.0 * (20_000 / nodes) ** (1.0 / 3.0))


def septa_from_landmarks(landmarks: SeptaLandmarks, spacing_mm: float = 5.0) -> tuple[Septum, ...]:
    """Build falx, left and right tentorium.

    The three sheets share the vertices of the straight sinus, where they meet.

    Parameters
    ----------
    landmarks
        In millimetres, patient frame.
    spacing_mm
        Distance between neighbouring vertices.

    Raises
    ------
    InputError
        A sheet is far too small to be one, or its landmarks span none.
    """
    sinus = resampled(landmarks.straight_sinus, spacing_mm)
    falx = landmarks.falx
    septa = [septum_inside("falx", sinus, falx.outer_edge, falx.free_edge, (), spacing_mm)]
    for side in (landmarks.tentorium.left, landmarks.tentorium.right_side):
        septa.append(septum_inside("tentorium", sinus, side.attachment, side.free_edge, side.surface, spacing_mm))
    return tuple(septa)


def septum_inside(
    name: SeptumName,
    sinus_mm: NDArray[np.float64],
    attached_mm: ArrayLike,
    free_mm: ArrayLike,
    interior_mm: ArrayLike,
    spacing_mm: float,
    normal: ArrayLike | None = None,
) -> Septum:
    """Span one sheet between the straight sinus, its edge on the skull and its free edge.

    Parameters
    ----------
    name
        Falx or tentorium.
    sinus_mm
        Shape (n, 3), mm, from the apex of the tentorial notch back to the torcula; its points become vertices as they are.
    attached_mm, free_mm
        Polylines of shape (m, 3), mm: from beside the torcula along the skull, and from there back to beside the apex.
    interior_mm
        Points of the sheet, shape (k, 3), mm; may be empty.
    spacing_mm
        Distance between neighbouring vertices.
    normal
        Side that the faces' normals point to; by default right for the falx and up for the tentorium.
    """
    if normal is None:
        normal = (1.0, 0.0, 0.0) if name == "falx" else (0.0, 0.0, 1.0)
    attached = resampled(np.vstack([sinus_mm[-1], attached_mm]), spacing_mm)
    free = resampled(np.vstack([attached[-1], free_mm, sinus_mm[0]]), spacing_mm)
    surface = sheet(np.vstack([sinus_mm, attached[1:], free[1:-1]]), interior_mm, normal, spacing_mm)
    first = len(sinus_mm) - 1
    return Septum(name, surface, np.arange(first, first + len(attached), dtype=np.int32))


def sheet(ring_mm: ArrayLike, interior_mm: ArrayLike, normal: ArrayLike, spacing_mm: float) -> Surface:
    """Span a sheet inside a closed edge, through points, as a height over a plane.

    The height is the thin-plate spline through edge and interior points (Duchon 1977), so the sheet bends as little as
    they allow.

    Parameters
    ----------
    ring_mm
        Closed edge, shape (n, 3), mm, the first point not repeated; these become vertices as they are.
    interior_mm
        Shape (m, 3), mm; may be empty.
    normal
        Side that the faces' normals point to, and the direction in which the sheet is a height: its projection along
        `normal` must not overlap itself.
    spacing_mm
        Distance between vertices inside.

    Raises
    ------
    InputError
        The edge is far too small or too large for a septum, crosses itself, or the points span no sheet.
    """
    ring = np.asarray(ring_mm, dtype=np.float64)
    interior = np.asarray(interior_mm, dtype=np.float64).reshape(-1, 3)
    extent = float(np.linalg.norm(np.ptp(ring, axis=0)))
    if not _SMALLEST_MM < extent < _LARGEST_MM:
        problem = f"a sheet measures {extent:.3g} mm from end to end"
        raise InputError("septa landmarks", problem, "give falx and tentorium of a human head, in mm")
    R = tangent_frame(normal)
    ring_local, known = ring @ R.T, np.vstack([ring, interior]) @ R.T
    # The spline's matrix would be singular, which its solver does not always notice.
    if len(np.unique(known[:, :2].round(3), axis=0)) < len(known):
        raise InputError("septa landmarks", "two points of a sheet lie above each other", "remove repeated points")
    crossing = _self_crossing(ring_local[:, :2])
    if crossing is not None:
        place = ", ".join(f"{value:.0f}" for value in ring[crossing])
        problem = f"a sheet's periphery crosses itself near ({place}) mm"
        raise InputError("septa landmarks", problem, "give its points in order, once around the sheet")
    height = RBFInterpolator(known[:, :2], known[:, 2], kernel="thin_plate_spline")
    polygon = Polygon(ring_local[:, :2])
    grid = _triangular_grid(ring_local[:, :2], spacing_mm)
    inside = polygon.contains_points(grid)
    distance = np.min(np.linalg.norm(grid[:, None] - ring_local[None, :, :2], axis=-1), axis=1)
    grid = grid[inside & (distance > 0.6 * spacing_mm)]
    local = np.vstack([ring_local, np.column_stack([grid, height(grid)])])
    faces = Delaunay(local[:, :2]).simplices
    faces = faces[polygon.contains_points(local[faces, :2].mean(axis=1))]
    return Surface(mm_to_m(local @ R), _turned_up(local, faces))


def _self_crossing(ring: NDArray[np.float64]) -> int | None:
    """Index of a segment of a closed polygon, shape (n, 2), that another crosses; None where the polygon is simple."""
    start, end = ring, np.roll(ring, -1, axis=0)

    def turn(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = b - a, c - a
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    p, q, r, s = start[:, None], end[:, None], start[None], end[None]
    crosses = (turn(p, q, r) * turn(p, q, s) < 0.0) & (turn(r, s, p) * turn(r, s, q) < 0.0)
    found = np.flatnonzero(crosses.any(axis=1))
    return int(found[0]) if len(found) else None


def _turned_up(local: NDArray[np.float64], faces: NDArray) -> NDArray[np.int32]:
    a, b, c = np.moveaxis(local[faces, :2], 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where(area[:, None] > 0, faces, faces[:, ::-1])
    return faces[np.abs(area) > 1e-6].astype(np.int32)


def _triangular_grid(points: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    low, high = points.min(axis=0), points.max(axis=0)
    rows = np.arange(low[1], high[1], spacing * np.sqrt(3) / 2)
    columns = np.arange(low[0] - spacing, high[0] + spacing, spacing)
    x, y = np.meshgrid(columns, rows)
    x = x + 0.5 * spacing * (np.arange(len(rows)) % 2)[:, None]
    return np.column_stack([x.ravel(), y.ravel()])


def resampled(points_mm: ArrayLike, spacing_mm: float) -> NDArray[np.float64]:
    """Resample a polyline of shape (n, 3) at about equal steps; its ends stay."""
    vertices = np.asarray(points_mm, dtype=np.float64)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(vertices, axis=0), axis=1))])
    steps = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / spacing_mm) + 1))
    return np.column_stack([np.interp(steps, arc, vertices[:, k]) for k in range(3)])

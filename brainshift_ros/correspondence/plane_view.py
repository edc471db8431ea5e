"""Scans seen straight from above a common plane in tracker space, so that a moved scanner makes no difference."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.speculars import specular_mask
from brainshift_ros.correspondence.vesselness import blood_contrast
from brainshift_ros.geometry import transform_points
from brainshift_ros.registration.scan import OrganisedScan

_LIGHT_SIGMA_M = 2.5e-3
_CONTRAST_SIGMA_M = 6e-3
_NOISE_CONTRAST = 0.03  # contrast of plain cortex: not to be blown up
_SPLAT_SIGMA = 0.7  # cells
_LEAST_COUNT = 0.08  # blurred points a cell
_LEAST_MATTE = 0.15


@dataclass(frozen=True)
class PlaneGrid:
    """A grid of square cells on a plane.

    Attributes
    ----------
    T_plane_tracker
        4x4; z is the height over the plane. Cell (0, 0) has its centre at the plane's origin, columns run along x.
    cell_m
        Cell size, metres.
    shape
        Rows and columns.
    """

    T_plane_tracker: NDArray[np.float64]
    cell_m: float
    shape: tuple[int, int]


@dataclass(frozen=True)
class PlaneView:
    """One scan resampled onto a plane grid.

    Attributes
    ----------
    texture
        Shape of the grid, float32: absorption of blood, scaled to unit local contrast; 0 where unseen.
    height
        Metres over the plane, NaN where unseen.
    seen
        Cells in which the scan has points.
    """

    texture: NDArray[np.float32]
    height: NDArray[np.float32]
    seen: NDArray[np.bool_]


def grid_over(points: NDArray[np.float64], cell_m: float, margin_m: float) -> PlaneGrid:
    """Grid on the principal plane of points (n, 3), tracker frame, with a margin on all sides."""
    center = points.mean(axis=0)
    _, axes = np.linalg.eigh((points - center).T @ (points - center))
    rotation = axes[:, ::-1].T
    # Signs of eigenvectors are arbitrary: fix them, so that the same scan gives the same grid.
    rotation *= np.sign(rotation[np.arange(3), np.abs(rotation).argmax(axis=1)])[:, None]
    rotation[2] = np.cross(rotation[0], rotation[1])
    local = (points - center) @ rotation.T
    low, high = local.min(axis=0) - margin_m, local.max(axis=0) + margin_m
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = -rotation @ center - [low[0], low[1], 0.0]
    columns, rows = np.ceil((high - low)[:2] / cell_m).astype(int) + 1
    return PlaneGrid(T, cell_m, (int(rows), int(columns)))


def _cells(
    scan: OrganisedScan, grid: PlaneGrid, use: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.float64]]:
    """Flat cell index of the points inside the grid, which of the used points those are, and their heights."""
    local = transform_points(grid.T_plane_tracker, scan.points[use].astype(np.float64))
    column, row = np.round(local[:, :2] / grid.cell_m).astype(np.int64).T
    rows, columns = grid.shape
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    return (row * columns + column)[inside], inside, local[inside, 2]


def _splat(grid: PlaneGrid, cell: NDArray[np.int64], values: NDArray[np.float64] | None = None) -> NDArray[np.float32]:
    """Sum of values (or the count) in each cell, blurred over neighbouring cells."""
    total = np.bincount(cell, weights=values, minlength=grid.shape[0] * grid.shape[1]).reshape(grid.shape)
    return np.asarray(cv2.GaussianBlur(total.astype(np.float32), (0, 0), _SPLAT_SIGMA), dtype=np.float32)


def covered_cells(scan: OrganisedScan, grid: PlaneGrid, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells of the grid that the scan's pixels `mask` (H, W) cover."""
    cell, _, _ = _cells(scan, grid, scan.seen & mask)
    return _splat(grid, cell) > _LEAST_COUNT


def view_scan(scan: OrganisedScan, grid: PlaneGrid) -> PlaneView:
    """Resample a scan by normalised convolution of its scattered points; glints are left out of the texture.

    Parameters
    ----------
    scan
        Tracker frame.
    grid
        Where to.
    """
    use = scan.seen
    cell, inside, height = _cells(scan, grid, use)
    matte = (~specular_mask(scan.rgb)[use][inside]).astype(np.float64)
    color = scan.rgb[use][inside].astype(np.float64)
    count, matte_count = _splat(grid, cell), _splat(grid, cell, matte)
    seen = count > _LEAST_COUNT
    mean_height = np.where(seen, _splat(grid, cell, height) / np.maximum(count, 1e-6), np.nan).astype(np.float32)
    mean_color = np.stack([_splat(grid, cell, color[:, c] * matte) for c in range(2)], axis=-1)
    mean_color /= np.maximum(matte_count, 1e-6)[..., None]
    weight = (matte_count > _LEAST_MATTE).astype(np.float32)
    flat = blood_contrast(mean_color, weight, _LIGHT_SIGMA_M / grid.cell_m)
    sigma = _CONTRAST_SIGMA_M / grid.cell_m
    variance = cv2.GaussianBlur(flat * flat, (0, 0), sigma) / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)
    texture = np.clip(flat / np.sqrt(variance + _NOISE_CONTRAST**2), -4.0, 4.0) * weight
    return PlaneView(texture.astype(np.float32), mean_height, seen)

"""Scans seen straight from above a common plane in tracker space, so that a moved scanner makes no difference."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import unit
from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.vessels.speculars import specular_mask
from brainshift_ros.vessels.vesselness import blood_contrast

_LIGHT_SIGMA_M = 2.5e-3
_CONTRAST_SIGMA_M = 6e-3
_NOISE_CONTRAST = 0.03  # contrast of plain cortex: not to be blown up
_SPLAT_SIGMA = 0.7  # cells
_LEAST_COUNT = 0.08  # blurred points a cell
_LEAST_MATTE = 0.15
_BRIDGE_M = 1.5e-3  # half the width of the dropouts that still get their colour
_LEAST_KNOWN = 0.1
_STEEP_M = 1.0e-3  # spread of heights across which no gap is bridged


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
class PlaneImage:
    """Colour and height of one scan over a plane grid.

    Attributes
    ----------
    color
        Shape of the grid and 3 channels, float32, 0 to 255; glints are left out.
    matte
        Cells that have a colour.
    height
        Metres over the plane, float32, NaN where unseen.
    """

    color: NDArray[np.float32]
    matte: NDArray[np.bool_]
    height: NDArray[np.float32]


@dataclass(frozen=True)
class PlaneView:
    """What of a scan can be matched, over a plane grid.

    Attributes
    ----------
    texture
        Shape of the grid, float32: absorption of blood, scaled to unit local contrast; 0 where not clear.
    height
        Metres over the plane, NaN where unseen.
    clear
        Cells that show cortex: seen, without glint or obstacle.
    """

    texture: NDArray[np.float32]
    height: NDArray[np.float32]
    clear: NDArray[np.bool_]


def grid_over(scan: OrganisedScan, mask: NDArray[np.bool_], cell_m: float, margin_m: float) -> PlaneGrid:
    """Grid on the principal plane of a scan's masked points, its columns along those of the scan.

    Parameters
    ----------
    scan
        Tracker frame.
    mask
        Shape (H, W): pixels that the plane is laid through, all seen.
    cell_m
        Cell size, metres.
    margin_m
        How far the grid reaches beyond those points, metres; never beyond what the scan saw.
    """
    points = scan.points[mask].astype(np.float64)
    center = points.mean(axis=0)
    normal = np.linalg.eigh((points - center).T @ (points - center))[1][:, 0]
    right, down = _steps(scan.points, mask)
    x = unit(right - (right @ normal) * normal)
    # The plane is turned so that z points to the scanner: a picture's rows run down, its columns to the right.
    z = -normal * np.sign(np.cross(x, down) @ normal)
    rotation = np.stack([x, np.cross(z, x), z])
    # Along rows of memory, since extremes over short last axes are slow.
    masked = rotation @ (points - center).T
    everything = rotation @ (scan.points[::4, ::4][scan.seen[::4, ::4]].astype(np.float64) - center).T
    low, high = masked.min(axis=1), masked.max(axis=1)
    low = np.maximum(low - margin_m, np.minimum(everything.min(axis=1), low))
    high = np.minimum(high + margin_m, np.maximum(everything.max(axis=1), high))
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = -rotation @ center - [low[0], low[1], 0.0]
    columns, rows = np.ceil((high - low)[:2] / cell_m).astype(int) + 1
    return PlaneGrid(T, cell_m, (int(rows), int(columns)))


def _steps(values: NDArray[np.float32], where: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Change of values (H, W, k) with column and with row over the pixels `where`, by least squares, shape (2, k)."""
    rows, columns = np.nonzero(where)
    rows, columns = rows[:: 1 + len(rows) // 20_000], columns[:: 1 + len(columns) // 20_000]
    design = np.stack([np.ones(len(rows)), columns, rows], axis=-1)
    return np.asarray(np.linalg.lstsq(design, values[rows, columns].astype(np.float64), rcond=None)[0][1:])


def plane_coordinates(scan: OrganisedScan, grid: PlaneGrid) -> NDArray[np.float32]:
    """Column and row (in cells) and height (metres) of each pixel of a scan, shape (H, W, 3), NaN where unseen."""
    T = grid.T_plane_tracker
    # About the grid's origin, so that single precision is enough: nanometres.
    origin = -T[:3, :3].T @ T[:3, 3]
    scale = np.array([[1.0 / grid.cell_m], [1.0 / grid.cell_m], [1.0]])
    return (scan.points - origin.astype(np.float32)) @ (scale * T[:3, :3]).T.astype(np.float32)


def bridge_dropouts(coordinates: NDArray[np.float32], spacing_m: float) -> NDArray[np.float32]:
    """Coordinates with small gaps filled from their surround, for the colour, which has no gaps there.

    Gaps are left where the surface is steep or broken: no rim is bridged.

    Parameters
    ----------
    coordinates
        From :func:`plane_coordinates`.
    spacing_m
        Distance of neighbouring pixels, metres.
    """
    known = np.isfinite(coordinates[..., 2])
    weight = known.astype(np.float32)
    filled = np.where(known[..., None], coordinates, np.float32(0.0))
    columns, rows = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in known.shape[::-1]))
    size = (2 * max(1, round(_BRIDGE_M / spacing_m)) + 1,) * 2
    mass = cv2.blur(weight, size, borderType=cv2.BORDER_CONSTANT)
    near = ~known & (mass > _LEAST_KNOWN)
    if not near.any():
        return coordinates

    def mean(values: NDArray) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(values * weight, size, borderType=cv2.BORDER_CONSTANT)[near] / mass[near])

    height = mean(filled[..., 2])
    smooth = mean(filled[..., 2] ** 2) - height**2 < _STEEP_M**2
    # A mean lies at the centroid of what was seen, not in the gap; pixels step evenly over the plane, so the offset is known.
    du, dv = columns[near] - mean(columns), rows[near] - mean(rows)
    right, down = _steps(coordinates[..., :2], known)
    at = np.stack([mean(filled[..., k]) + du * right[k] + dv * down[k] for k in range(2)] + [height], axis=-1)
    result = coordinates.copy()
    result[near] = np.where(smooth[:, None], at, np.nan)
    return result


def _splat(grid: PlaneGrid, cell: NDArray[np.int64], values: NDArray | None = None) -> NDArray[np.float32]:
    """Sum of values (or the count) in each cell, blurred over neighbouring cells."""
    total = np.bincount(cell, weights=values, minlength=grid.shape[0] * grid.shape[1]).reshape(grid.shape)
    return np.asarray(cv2.GaussianBlur(total.astype(np.float32), (0, 0), _SPLAT_SIGMA), dtype=np.float32)


def _cells(coordinates: NDArray[np.float32], grid: PlaneGrid) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Flat pixel numbers of the points inside the grid, and the flat cell of each."""
    rows, columns = grid.shape
    column, row = coordinates[..., 0].ravel(), coordinates[..., 1].ravel()
    # NaN compares false.
    pixel = np.flatnonzero((column > -0.5) & (column < columns - 0.5) & (row > -0.5) & (row < rows - 0.5))
    cell = np.rint(row[pixel]).astype(np.int64) * columns + np.rint(column[pixel]).astype(np.int64)
    return pixel, cell


def covered_cells(scan: OrganisedScan, grid: PlaneGrid, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells of the grid that the scan's pixels `mask` (H, W) cover."""
    pixel, cell = _cells(plane_coordinates(scan, grid), grid)
    return _splat(grid, cell[mask.ravel()[pixel]]) > _LEAST_COUNT


def resample(scan: OrganisedScan, grid: PlaneGrid) -> PlaneImage:
    """Resample a scan by normalised convolution of its scattered points.

    Parameters
    ----------
    scan
        Tracker frame.
    grid
        Where to.
    """
    measured = plane_coordinates(scan, grid)
    pixel, cell = _cells(measured, grid)
    count = _splat(grid, cell)
    height = _splat(grid, cell, measured[..., 2].ravel()[pixel]) / np.maximum(count, 1e-6)
    height[count <= _LEAST_COUNT] = np.nan

    pixel, cell = _cells(bridge_dropouts(measured, pixel_spacing(scan)), grid)
    matte = ~specular_mask(scan.rgb).ravel()[pixel]
    pixel, cell = pixel[matte], cell[matte]
    count = _splat(grid, cell)
    color = scan.rgb.reshape(-1, 3)[pixel]
    mean_color = np.stack([_splat(grid, cell, color[:, c]) for c in range(3)], axis=-1)
    mean_color /= np.maximum(count, 1e-6)[..., None]
    return PlaneImage(mean_color, count > _LEAST_MATTE, height.astype(np.float32))


def matchable(image: PlaneImage, obstacles: NDArray[np.bool_], cell_m: float) -> PlaneView:
    """Texture of the cortex, without light and shade, at unit local contrast; obstacles left out.

    Parameters
    ----------
    image
        From :func:`resample`.
    obstacles
        Cells that do not show cortex.
    cell_m
        Cell size, metres.
    """
    clear = image.matte & ~obstacles
    weight = clear.astype(np.float32)
    flat = blood_contrast(image.color, weight, _LIGHT_SIGMA_M / cell_m)
    # The contrast varies slowly: its mean square is taken on a coarser grid.
    factor = min(1.0, 4 * cell_m / _CONTRAST_SIGMA_M)
    sigma = _CONTRAST_SIGMA_M / cell_m * factor
    size = (max(1, round(flat.shape[1] * factor)), max(1, round(flat.shape[0] * factor)))
    small = (cv2.resize(values, size, interpolation=cv2.INTER_AREA) for values in (flat * flat, weight))
    square, mass = (cv2.GaussianBlur(values, (0, 0), sigma) for values in small)
    variance = cv2.resize(square / np.maximum(mass, 1e-3), flat.shape[::-1], interpolation=cv2.INTER_LINEAR)
    texture = np.clip(flat / np.sqrt(variance + _NOISE_CONTRAST**2), -4.0, 4.0) * weight
    return PlaneView(texture.astype(np.float32), image.height, clear)

"""A person's few pairs of points, which replace the automatic coarse match where that fails (thesis appendix E)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.plane_view import PlaneGrid, plane_coordinates
from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan

LEAST_PAIRS = 3
_REACH_PX = 6


@dataclass(frozen=True)
class Guides:
    """Pairs of pixels that show the same spot of the cortex.

    Attributes
    ----------
    first_px, later_px
        Shape (n, 2), (row, column), in the textures of the first and the later scan; n >= 3.

    Raises
    ------
    InputError
        When the shapes differ, fewer than three pairs are given, or a number is not finite.
    """

    first_px: NDArray[np.float64]
    later_px: NDArray[np.float64]

    def __post_init__(self) -> None:
        first, later = np.asarray(self.first_px, dtype=np.float64), np.asarray(self.later_px, dtype=np.float64)
        if first.ndim != 2 or first.shape[1:] != (2,) or first.shape != later.shape:
            raise InputError("guides", f"shapes {first.shape} and {later.shape}", "give (row, column) of each in both textures")
        if len(first) < LEAST_PAIRS:
            raise InputError("guides", f"{len(first)} pairs", f"give at least {LEAST_PAIRS}, spread over the cortex")
        if not (np.isfinite(first).all() and np.isfinite(later).all()):
            raise InputError("guides", "a pixel is not finite", "give (row, column) numbers")
        object.__setattr__(self, "first_px", first)
        object.__setattr__(self, "later_px", later)


def cells_of_pixels(scan: OrganisedScan, grid: PlaneGrid, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cells (column, row) in which a scan's pixels lie: a plane fitted to the points seen around each.

    Parameters
    ----------
    scan
        Tracker frame.
    grid
        Over the cortex.
    pixels
        Shape (n, 2), (row, column), need not be whole numbers.

    Returns
    -------
    cells
        Shape (n, 2); NaN where the scan saw nothing within 6 pixels, or the pixel lies outside the texture.
    """
    coordinates = plane_coordinates(scan, grid)[..., :2]
    height, width = scan.seen.shape
    result = np.full((len(pixels), 2), np.nan)
    for k, (row, column) in enumerate(pixels):
        if not (0 <= row <= height - 1 and 0 <= column <= width - 1):
            continue
        r, c = round(row), round(column)
        window = (slice(max(r - _REACH_PX, 0), r + _REACH_PX + 1), slice(max(c - _REACH_PX, 0), c + _REACH_PX + 1))
        seen = np.isfinite(coordinates[window]).all(axis=-1)
        rows, columns = np.nonzero(seen)
        if len(rows) < 6:
            continue
        du, dv = columns + window[1].start - column, rows + window[0].start - row
        weight = np.exp(-0.25 * np.hypot(du, dv))
        design = np.stack([np.ones_like(du), du, dv], axis=-1) * weight[:, None]
        fit, _, rank, _ = np.linalg.lstsq(design, coordinates[window][seen] * weight[:, None], rcond=None)
        if rank == 3:
            result[k] = fit[0]
    return result

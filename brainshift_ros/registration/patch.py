"""A scan thinned on its own pixel grid: points with normals that face the scanner."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan

_LEAST_SEEN = 0.3  # share of a block's pixels that make it a point
_LEAST_AROUND = 0.1  # share of the blocks around a point that gives it a normal
_NORMAL_REACH_M = 2e-3


@dataclass(frozen=True)
class OrientedPoints:
    """Points (n, 3), metres, and unit normals (n, 3) out of the head, both in one frame."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]

    def thinned(self, count: int) -> OrientedPoints:
        """At most `count` of the points, drawn with a fixed seed: a fixed step would draw lines of an organised cloud."""
        if len(self.points) <= count:
            return self
        chosen = np.sort(np.random.default_rng(0).permutation(len(self.points))[:count])
        return OrientedPoints(self.points[chosen], self.normals[chosen])


@dataclass(frozen=True)
class ScanPatch:
    """A scan's blocks of pixels.

    Attributes
    ----------
    points
        Shape (h, w, 3), float64, mean of the block's seen points in the opening, tracker frame, metres; NaN where too few.
    normals
        Shape (h, w, 3), unit normals towards the scanner; NaN where the points around do not tell.
    block
        Pixels of the scan along an edge of a block.
    spacing_m
        Distance between neighbouring blocks, metres.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    block: int
    spacing_m: float

    @property
    def oriented(self) -> NDArray[np.bool_]:
        """Shape (h, w): blocks with both a point and a normal."""
        return np.asarray(np.isfinite(self.points[..., 0]) & np.isfinite(self.normals[..., 0]))

    def cloud(self, where: NDArray[np.bool_] | None = None) -> OrientedPoints:
        """Oriented blocks, of `where` only when it is given (shape (h, w))."""
        chosen = self.oriented if where is None else self.oriented & where
        return OrientedPoints(self.points[chosen], self.normals[chosen])


def scan_patch(scan: OrganisedScan, mask: NDArray[np.bool_], spacing_m: float) -> ScanPatch:
    """Thin the masked part of a scan to a spacing by means over square blocks of pixels, with normals.

    Rows of an organised cloud run down and columns to the right as the scanner sees them (REP 118), so the product of the
    two directions points away from the scanner, and its opposite out of the head. A mirrored cloud has it the wrong way.
    """
    spacing = pixel_spacing(scan)
    block = max(1, round(spacing_m / spacing))
    height, width = (size // block for size in scan.seen.shape)
    inside = mask & scan.seen
    # Sums in double precision about the middle: a tracker may be metres away.
    middle = scan.points[inside].mean(axis=0, dtype=np.float64)
    offset = np.where(inside[..., None], scan.points - middle.astype(np.float32), 0.0).astype(np.float32)
    crop = (slice(0, height * block), slice(0, width * block))
    share, mean = (
        cv2.resize(values[crop], (width, height), interpolation=cv2.INTER_AREA).astype(np.float64)
        for values in (inside.astype(np.float32), offset)
    )
    points = np.full((height, width, 3), np.nan)
    full = share >= _LEAST_SEEN
    points[full] = mean[full] / share[full, None] + middle
    return ScanPatch(points, _normals(mean, share, max(1, round(_NORMAL_REACH_M / (block * spacing)))), block, block * spacing)


def _normals(sums: NDArray[np.float64], share: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Take normals from means over windows `reach` blocks to each side, differenced across the window."""
    size = (2 * reach + 1, 2 * reach + 1)
    weight, smooth = (cv2.boxFilter(np.ascontiguousarray(v), -1, size, normalize=False) for v in (share, sums))
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = np.where((weight > _LEAST_AROUND * size[0] * size[1])[..., None], smooth / weight[..., None], np.nan)
        across, down = np.full_like(smooth, np.nan), np.full_like(smooth, np.nan)
        across[:, reach:-reach] = smooth[:, 2 * reach :] - smooth[:, : -2 * reach]
        down[reach:-reach] = smooth[2 * reach :] - smooth[: -2 * reach]
        towards = np.cross(down, across)
        return np.asarray(towards / np.linalg.norm(towards, axis=-1, keepdims=True))

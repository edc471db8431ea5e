"""Which pixels of a scan look like the cortex in the opening: colour and connection to where the scanner was aimed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan

_PIXEL_M = 0.4e-3  # colour is judged at this spacing
_CENTRAL_RADIUS_M = 15e-3
_CHROMA_GATE = 9.0  # squared Mahalanobis distance, about 99 % of a two-dimensional normal distribution
_BRIDGED_M = 2.0e-3
_MARGIN_M = 1.5e-3
_LEAST_COLOURED = 100  # pixels around the middle from which the colour of cortex can be learnt


def pixel_spacing(scan: OrganisedScan) -> float:
    """Median distance between neighbouring pixels of the scan, metres.

    Measured over 16 pixels: between neighbours the range noise would be longer than the step.

    Raises
    ------
    InputError
        No two pixels that far apart in a row were seen.
    """
    lag = min(16, scan.points.shape[1] // 4)
    rows = scan.points[::4]
    step = np.linalg.norm(rows[:, lag:] - rows[:, :-lag], axis=-1)
    measured = step[np.isfinite(step)]
    if measured.size == 0:
        raise InputError("scan", "its points are too scattered over the picture", "send a dense organised scan")
    return float(np.median(measured)) / lag


def opening_mask(scan: OrganisedScan) -> NDArray[np.bool_]:
    """Pixels that look like the cortex around the middle of the scan.

    A scanner is aimed at the opening, so the middle of the seen points teaches the colour of cortex (chromaticity, so that
    light and shade do not matter). Pixels of that colour that connect to the middle make the opening; its margin, where the
    dura is close in height and colour, is left out.

    Returns
    -------
    mask
        Shape (H, W). Where colour tells nothing apart, or the middle was not seen, all seen pixels pass, and the robust
        kernel has to cope.
    """
    seen = scan.seen
    spacing = pixel_spacing(scan)
    block = max(1, round(_PIXEL_M / spacing))
    height, width = (size // block for size in seen.shape)
    crop = (slice(0, height * block), slice(0, width * block))
    rgb = np.asarray(cv2.resize(scan.rgb[crop], (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    seen_small = cv2.resize(seen[crop].astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    region = _opening(rgb, seen_small, spacing * block)
    if region is None:
        return seen
    mask = np.zeros(seen.shape, dtype=bool)
    mask[crop] = cv2.resize(region.astype(np.uint8), (width * block, height * block), interpolation=cv2.INTER_NEAREST) > 0
    opening = mask & seen
    return opening if opening.any() else seen


def _opening(rgb: NDArray[np.uint8], seen: NDArray[np.bool_], spacing: float) -> NDArray[np.bool_] | None:
    """Region (h, w) of the colour of the middle, holes filled; None where the middle teaches nothing."""
    smooth = cv2.GaussianBlur(rgb, (0, 0), max(0.6e-3 / spacing, 0.7)).astype(np.float32) + 4.0
    rows, columns = np.nonzero(seen)
    v, u = np.indices(seen.shape)
    central = seen & (np.hypot(v - np.median(rows), u - np.median(columns)) < _CENTRAL_RADIUS_M / spacing)
    if central.sum() < _LEAST_COLOURED:
        return None
    chroma = np.log(np.stack([smooth[..., 0] / smooth[..., 1], smooth[..., 1] / smooth[..., 2]], axis=-1))
    # Vessels are darker in green than cortex, and would make room for dura and bone in its colour.
    green = smooth[central, 1]
    mean, spread = _trimmed_normal(chroma[central][green >= np.quantile(green, 0.4)])
    offset = chroma - mean
    distance = np.einsum("hwi,hwi->hw", offset @ np.linalg.inv(spread).astype(np.float32), offset)
    alike = (distance < _CHROMA_GATE).astype(np.uint8)

    def disc(radius_m: float) -> NDArray[np.uint8]:
        size = 2 * max(1, round(radius_m / spacing)) + 1
        return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)

    # Vessels and glints are bridged; thin links to look-alikes elsewhere are cut.
    alike = cv2.morphologyEx(alike, cv2.MORPH_CLOSE, disc(_BRIDGED_M))
    alike = cv2.morphologyEx(alike, cv2.MORPH_OPEN, disc(_BRIDGED_M))
    count, labels = cv2.connectedComponents(alike, connectivity=4)
    votes = np.bincount(labels[central], minlength=count)
    votes[0] = 0
    if not votes.any():
        return None
    region = ndimage.binary_fill_holes(labels == votes.argmax())
    return np.asarray(cv2.erode(np.pad(region.astype(np.uint8), 1), disc(_MARGIN_M))[1:-1, 1:-1] > 0)


def _trimmed_normal(sample: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Mean (2,) and covariance (2, 2) of most of a sample (n, 2): the farthest tenth is left out three times."""
    mean = np.median(sample, axis=0)
    spread = np.cov(sample.T)
    for _ in range(3):
        offset = sample - mean
        distance = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(spread + 0.01**2 * np.eye(2)), offset)
        sample = sample[distance <= np.quantile(distance, 0.9)]
        mean, spread = sample.mean(axis=0), np.cov(sample.T)
    return mean, spread + 0.02**2 * np.eye(2)

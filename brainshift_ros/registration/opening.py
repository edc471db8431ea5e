"""Which pixels of a scan look like the cortex in the opening: colour and connection to where the scanner was aimed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan

_CENTRAL_RADIUS_M = 15e-3
_CHROMA_GATE = 9.0  # squared Mahalanobis distance, about 99 % of a two-dimensional normal distribution
_MARGIN_M = 2.5e-3
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
    sigma = max(0.6e-3 / spacing, 0.7)
    rgb = cv2.GaussianBlur(scan.rgb, (0, 0), sigma).astype(np.float32) + 4.0
    chroma = np.log(np.stack([rgb[..., 0] / rgb[..., 1], rgb[..., 1] / rgb[..., 2]], axis=-1))
    rows, columns = np.nonzero(seen)
    middle = (np.median(rows), np.median(columns))
    v, u = np.indices(seen.shape)
    central = seen & (np.hypot(v - middle[0], u - middle[1]) < _CENTRAL_RADIUS_M / spacing)
    if central.sum() < _LEAST_COLOURED:
        return seen
    sample = chroma[central]
    mean = np.median(sample, axis=0)
    deviation = np.abs(sample - mean).sum(axis=1)
    spread = np.cov(sample[deviation <= np.quantile(deviation, 0.9)].T)
    spread = 1.6 * spread + 0.02**2 * np.eye(2)
    offset = (chroma - mean).reshape(-1, 2)
    distance = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(spread), offset).reshape(seen.shape)
    alike = (distance < _CHROMA_GATE).astype(np.uint8)

    def disc(radius_m: float) -> NDArray[np.uint8]:
        size = 2 * max(1, round(radius_m / spacing)) + 1
        return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)

    # Vessels and glints are bridged; thin links to look-alikes elsewhere are cut.
    alike = cv2.morphologyEx(alike, cv2.MORPH_CLOSE, disc(2.0e-3))
    alike = cv2.morphologyEx(alike, cv2.MORPH_OPEN, disc(2.0e-3))
    labels, _ = ndimage.label(alike)
    votes = np.bincount(labels[central], minlength=2)
    votes[0] = 0
    region = ndimage.binary_fill_holes(labels == votes.argmax()) if votes.any() else seen
    region = cv2.erode(np.pad(region.astype(np.uint8), 1), disc(_MARGIN_M))[1:-1, 1:-1] > 0
    opening = region & seen
    return opening if opening.any() else seen

"""Specular spots: found by brightness and lack of colour, repaired from their surround."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_BRIGHTER, _PALER, _WHITE = 1.35, 0.1, 0.95  # of the darkest channel, and of its ratio to the brightest one
_LEAST_LEVEL = 60.0
_COARSER, _WINDOW = 4, 0.1  # window of the local median, of the picture's width


def specular_mask(rgb: NDArray[np.uint8], grow_px: int = 2) -> NDArray[np.bool_]:
    """Pixels, shape (H, W), whose colour is the lamp's and not the tissue's.

    Wet tissue reflects the lamp itself: brighter than around it in all channels, and paler.
    """
    red, green, blue = cv2.split(rgb)
    low, high = cv2.min(cv2.min(red, green), blue), cv2.max(cv2.max(red, green), blue)
    low_around, high_around = (_local_median(channel) for channel in (low, high))
    low, high = low.astype(np.float32), high.astype(np.float32)
    brighter = low > np.maximum(_BRIGHTER * low_around, _LEAST_LEVEL)
    # Against the surround: a cold lamp makes all the cortex nearly white.
    paler = low * high_around > high * np.minimum(low_around + _PALER * high_around, _WHITE * high_around)
    glint = brighter & paler
    size = 2 * grow_px + 1
    return cv2.dilate(glint.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0


def _local_median(channel: NDArray) -> NDArray[np.float32]:
    """Median over a window much wider than a glint, shape (H, W)."""
    size = (max(1, channel.shape[1] // _COARSER), max(1, channel.shape[0] // _COARSER))
    small = cv2.resize(np.ascontiguousarray(channel), size, interpolation=cv2.INTER_AREA)
    window = 2 * max(1, round(_WINDOW * size[0] / 2)) + 1
    median = cv2.medianBlur(small, window).astype(np.float32)
    return np.asarray(cv2.resize(median, channel.shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def repair_speculars(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Inpaint specular spots (Telea 2004).

    Returns
    -------
    repaired, mask
        Shapes (H, W, 3) and (H, W).
    """
    mask = specular_mask(rgb)
    repaired = cv2.inpaint(np.ascontiguousarray(rgb), mask.astype(np.uint8), 3, cv2.INPAINT_TELEA)
    return np.asarray(repaired, dtype=np.uint8), mask

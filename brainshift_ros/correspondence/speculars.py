"""Specular spots: found by brightness and lack of colour, repaired from their surround."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def specular_mask(rgb: NDArray[np.uint8], grow_px: int = 2) -> NDArray[np.bool_]:
    """Pixels, shape (H, W), whose colour is the lamp's and not the tissue's.

    Wet tissue reflects the lamp itself: all channels high, hence nearly white. Cortex keeps blue and green well below red.
    """
    low = rgb.min(axis=-1).astype(np.float32)
    high = rgb.max(axis=-1).astype(np.float32)
    tissue = float(np.median(low[high > 20])) if np.any(high > 20) else 0.0
    glint = (low > max(1.5 * tissue, 110.0)) & (low > 0.72 * high)
    size = 2 * grow_px + 1
    return cv2.dilate(glint.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0


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

"""Widths of traced vessels from the profile of contrast across them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

_HALF_WIDEST_M = 1.6e-3
_TANGENT_SIGMA_PX = 2.0  # smooths the staircase of a pixel path
_DEPTH_SIGMA_M = 0.5e-3  # along the vessel
_PROFILE_STEP_PX = 0.25


def widths_across(flat: NDArray[np.float32], pixels: NDArray[np.float64], pixel_m: float) -> NDArray[np.float64]:
    """Full width at half absorption along a path.

    Parameters
    ----------
    flat
        Shape (H, W), blood contrast, negative on vessels.
    pixels
        Shape (n, 2), n >= 2, (row, column) along the vessel.
    pixel_m
        Pixel size, metres.

    Returns
    -------
    width_m
        Shape (n,), metres, at most 3.2 mm; a pixel where there is no contrast.

    Notes
    -----
    Half of the vessel's *own* absorption counts, so a thin vessel beside a dark wide one keeps its width.
    """
    smooth = np.stack([gaussian_filter1d(pixels[:, axis], _TANGENT_SIGMA_PX, mode="nearest") for axis in range(2)], axis=-1)
    tangent = np.gradient(smooth, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    reach = _HALF_WIDEST_M / pixel_m
    offset = np.arange(-reach, reach + _PROFILE_STEP_PX, _PROFILE_STEP_PX)
    row = smooth[:, :1] - tangent[:, 1:] * offset  # the normal of (dr, dc) is (-dc, dr)
    column = smooth[:, 1:] + tangent[:, :1] * offset
    profile = cv2.remap(
        flat, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    # Half of the covered light, not of its logarithm, is where a pixel is half covered.
    profile = gaussian_filter1d(np.expm1(profile), _DEPTH_SIGMA_M / pixel_m, axis=0, mode="nearest")
    # The path may miss the middle by a pixel.
    middle = len(offset) // 2
    near = slice(middle - round(1 / _PROFILE_STEP_PX), middle + round(1 / _PROFILE_STEP_PX) + 1)
    deepest = profile[:, near].argmin(axis=1) + near.start
    depth = np.minimum(profile[np.arange(len(profile)), deepest], 0.0)
    outside = profile > 0.5 * depth[:, None]
    index = np.arange(len(offset))
    right = np.where(outside & (index >= deepest[:, None]), index, len(offset) - 1).min(axis=1)
    left = np.where(outside & (index <= deepest[:, None]), index, 0).max(axis=1)
    return np.asarray(np.maximum((right - left - 1) * _PROFILE_STEP_PX, 1.0) * pixel_m, dtype=np.float64)

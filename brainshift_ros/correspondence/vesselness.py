"""How much each pixel looks like a dark vessel: multi-scale Hessian ridges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_RED_SHARE = 0.8
_DARK_LEVEL = 8.0
_HALF_WIDEST_M = 1.2e-3


def blood_contrast(rgb: NDArray, weight: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Absorption of blood, without light and shade.

    Haemoglobin takes far more green than red light, while a shadow or a sulcus takes both: log(green) - 0.8 log(red), minus
    its local mean. Some of the red stays, since in the darkest vessels the ratio is mostly noise.

    Parameters
    ----------
    rgb
        Shape (H, W, 3), 0 to 255.
    weight
        Shape (H, W), 1 where the colour counts, else 0.
    sigma_px
        Extent of the local mean, pixels.

    Returns
    -------
    contrast
        Shape (H, W), float32, negative on vessels, zero where `weight` is zero.
    """
    colour = rgb.astype(np.float32) + _DARK_LEVEL
    log = np.log(colour[..., 1]) - _RED_SHARE * np.log(colour[..., 0])
    mass = cv2.GaussianBlur(weight, (0, 0), sigma_px)
    mean = cv2.GaussianBlur(log * weight, (0, 0), sigma_px) / np.maximum(mass, 1e-3)
    return (log - mean) * weight


def vesselness(
    flat: NDArray[np.float32], pixel_m: float, scales_m: tuple[float, ...] = (0.2e-3, 0.35e-3, 0.6e-3, 0.9e-3)
) -> NDArray[np.float32]:
    """Ridge strength of dark lines, largest over the scales.

    Parameters
    ----------
    flat
        Shape (H, W), from :func:`blood_contrast`.
    pixel_m
        Pixel size, metres.
    scales_m
        Standard deviations of the Gaussian; a bar of width w answers most at w / 2.

    Returns
    -------
    strength
        Shape (H, W): sigma^2 (lambda_2 - |lambda_1|) where the second derivative across is positive, else 0: about half
        the contrast of the vessel in logarithmic intensity.
    """
    best = np.zeros(flat.shape, dtype=np.float32)
    for scale_m in scales_m:
        sigma = max(scale_m / pixel_m, 0.8)
        smooth = cv2.GaussianBlur(flat, (0, 0), sigma)
        xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3, scale=0.25)
        yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3, scale=0.25)
        xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
        half_trace = 0.5 * (xx + yy)
        root = cv2.sqrt(cv2.pow(0.5 * (xx - yy), 2) + xy * xy)
        across, along = half_trace + root, half_trace - root
        np.maximum(best, sigma**2 * (across - np.abs(along)), out=best)
    return best


def vessel_width(flat: NDArray[np.float32], pixel_m: float) -> NDArray[np.float32]:
    """Full width at half contrast, metres, shape (H, W); right on centre lines, at least one pixel."""
    smooth = cv2.GaussianBlur(flat, (0, 0), 0.7)
    size = 2 * max(1, round(_HALF_WIDEST_M / pixel_m)) + 1
    deepest = cv2.erode(smooth, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    inside = (smooth < 0.5 * np.minimum(deepest, 0.0)).astype(np.uint8)
    to_edge = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    # A traced centre line may miss the true one by a pixel; distances count from pixel centres.
    nearby = cv2.dilate(to_edge, np.ones((3, 3), np.uint8))
    return np.asarray(np.maximum(2.0 * nearby - 1.0, 1.0) * pixel_m, dtype=np.float32)

"""How much each pixel looks like a dark vessel: multi-scale Hessian ridges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_DARK_LEVEL = 8.0
_BLOB_PENALTY = 0.3  # of a full one branch points would vanish, of none dark spots pass


def blood_contrast(rgb: NDArray, weight: NDArray[np.float32], sigma_px: float, red_share: float = 0.8) -> NDArray[np.float32]:
    """Absorption of blood, without light and shade.

    Haemoglobin takes far more green than red light, while a shadow or a sulcus takes both: log(green) - share log(red), minus
    its local mean.

    Parameters
    ----------
    rgb
        Shape (H, W, 3), 0 to 255.
    weight
        Shape (H, W), 1 where the colour counts, else 0.
    sigma_px
        Extent of the local mean, pixels.
    red_share
        1 removes light and shade wholly, but in the darkest vessels the ratio is mostly noise.

    Returns
    -------
    contrast
        Shape (H, W), float32, negative on vessels, zero where `weight` is zero.
    """
    colour = rgb.astype(np.float32) + _DARK_LEVEL
    log = np.log(colour[..., 1]) - red_share * np.log(colour[..., 0])
    mass = cv2.GaussianBlur(weight, (0, 0), sigma_px)
    mean = cv2.GaussianBlur(log * weight, (0, 0), sigma_px) / np.maximum(mass, 1e-3)
    return (log - mean) * weight


def vesselness(
    flat: NDArray[np.float32], pixel_m: float, scales_m: tuple[float, ...] = (0.2e-3, 0.35e-3, 0.6e-3)
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
        Shape (H, W): sigma^2 (lambda_2 - 0.3 |lambda_1|) where the second derivative across is positive, else 0: about half
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
        np.maximum(best, sigma**2 * (across - _BLOB_PENALTY * np.abs(along)), out=best)
    return best

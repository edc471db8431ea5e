"""What the cortex looks like: a picture in material coordinates, so that it moves with the tissue."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.simulation.vessels import PaintedVessel

_PIXEL_M = 0.12e-3
_SUBPIXEL_BITS = 6
_CORTEX = np.array([0.80, 0.55, 0.47])
_ARTERY = np.array([0.62, 0.12, 0.10])
_VEIN = np.array([0.33, 0.10, 0.15])


@dataclass(frozen=True)
class CortexTexture:
    """Reflectance over the craniotomy's xy plane.

    Attributes
    ----------
    image
        Shape (n, n, 3), float32 linear RGB; rows follow y, columns x.
    pixel_m
        Pixel size, metres; the image is centred on the craniotomy's origin.
    """

    image: NDArray[np.float32]
    pixel_m: float

    def __call__(self, xy: NDArray[np.float64]) -> NDArray[np.float32]:
        """Reflectance, shape (H, W, 3), at craniotomy coordinates of shape (H, W, 2) in metres."""
        center = 0.5 * (len(self.image) - 1)
        index = (np.nan_to_num(xy) / self.pixel_m + center).astype(np.float32)
        sampled = cv2.remap(self.image, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(sampled, dtype=np.float32)


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], scale_px: float) -> NDArray[np.float32]:
    """Gaussian random field of unit variance and the given correlation length, computed on a coarser grid."""
    step = max(scale_px / 3.0, 1.0)
    coarse = (int(np.ceil(shape[0] / step)) + 4, int(np.ceil(shape[1] / step)) + 4)
    field = cv2.GaussianBlur(rng.standard_normal(coarse).astype(np.float32), (0, 0), max(scale_px / step, 0.6))
    field = (field - field.mean()) / max(float(field.std()), 1e-9)
    return cv2.resize(field, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)


def paint_texture(
    vessels: tuple[PaintedVessel, ...],
    sulcal_depth_m: NDArray[np.float64],
    half_width_m: float,
    rng: np.random.Generator,
) -> CortexTexture:
    """Paint cortex, sulci and vessels.

    Parameters
    ----------
    vessels
        Vessel trees; later ones run over earlier ones.
    sulcal_depth_m
        Shape (k, k), depth below the smooth hull on a square grid of the same extent.
    half_width_m
        Half the side of the picture, metres.
    rng
        Source of the mottling.
    """
    n = 2 * round(half_width_m / _PIXEL_M) + 1
    shape = (n, n)
    mottle = 0.05 * smooth_noise(rng, shape, 6e-3 / _PIXEL_M) + 0.025 * smooth_noise(rng, shape, 1.2e-3 / _PIXEL_M)
    redness = 0.03 * smooth_noise(rng, shape, 9e-3 / _PIXEL_M)
    image = (_CORTEX * (1.0 + mottle[..., None])).astype(np.float32)
    image[..., 0] += redness
    depth = cv2.resize(sulcal_depth_m.astype(np.float32), (n, n), interpolation=cv2.INTER_CUBIC)
    image *= np.exp(-np.clip(depth, 0.0, 8e-3) / 9e-3)[..., None]
    scale, center = 2**_SUBPIXEL_BITS, 0.5 * (n - 1)
    for vessel in vessels:
        alpha = np.zeros(shape, dtype=np.uint8)
        at = np.round((vessel.path / _PIXEL_M + center) * scale).astype(np.int32)
        for a, b, width in zip(at[:-1], at[1:], vessel.width[:-1], strict=True):
            cv2.line(alpha, a.tolist(), b.tolist(), 255, max(1, round(width / _PIXEL_M)), cv2.LINE_AA, _SUBPIXEL_BITS)
        box = cv2.boundingRect(alpha)
        window = (slice(box[1], box[1] + box[3]), slice(box[0], box[0] + box[2]))
        cover = cv2.GaussianBlur(alpha[window], (0, 0), 0.8).astype(np.float32)[..., None] / 255.0
        width = float(vessel.width.max())
        thin = float(
            np.clip(width / 1.5e-3, 0.45 * min(width / 0.4e-3, 1.0), 0.95)
        )  # thin vessels let the cortex shine through
        color = (_VEIN if vessel.vein else _ARTERY) * rng.uniform(0.85, 1.15)
        image[window] += cover * thin * (color.astype(np.float32) - image[window])
    return CortexTexture(np.clip(image, 0.0, 1.0), _PIXEL_M)

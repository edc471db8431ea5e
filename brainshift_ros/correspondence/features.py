"""Features of a plane view that are recognised however the cortex has turned: SIFT (Lowe 2004) on its texture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.plane_view import PlaneView

_CELL_M = 0.3e-3  # vessels of 0.4 to 2 mm are the scales of the first two octaves; finer cells find no more
_CONTRAST, _EDGE = 0.01, 20.0  # vessels are edges: crossings and bends pass, straight ones do not


@dataclass(frozen=True)
class Features:
    """Key points with orientation and descriptor.

    Attributes
    ----------
    at
        Shape (n, 2), (column, row) in cells of the view.
    turn
        Shape (n,), orientation, radians.
    descriptor
        Shape (n, 128).
    """

    at: NDArray[np.float64]
    turn: NDArray[np.float64]
    descriptor: NDArray[np.float32]


def as_bytes(texture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Texture for OpenCV's feature functions: -4 to 4 becomes 0 to 255."""
    return np.asarray(np.clip(128.0 + 31.0 * texture, 0, 255), dtype=np.uint8)


def find_features(view: PlaneView, region: NDArray[np.bool_], cell_m: float) -> Features:
    """Find key points in a region of the view.

    Parameters
    ----------
    view
        Texture of the cortex.
    region
        Cells to look in.
    cell_m
        Cell size, metres.
    """
    factor = min(1.0, cell_m / _CELL_M)
    size = (max(1, round(view.texture.shape[1] * factor)), max(1, round(view.texture.shape[0] * factor)))
    small = cv2.resize(as_bytes(view.texture), size, interpolation=cv2.INTER_AREA)
    mask = cv2.resize(region.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    sift = cv2.SIFT.create(contrastThreshold=_CONTRAST, edgeThreshold=_EDGE)
    found, descriptor = sift.detectAndCompute(small, mask * 255)
    if not found:
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), dtype=np.float32))
    scale = np.array(view.texture.shape[::-1]) / np.array(size)
    at = (np.array([point.pt for point in found]) + 0.5) * scale - 0.5
    return Features(at, np.deg2rad([point.angle for point in found]), np.asarray(descriptor, dtype=np.float32))

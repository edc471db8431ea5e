"""The one place where millimetres become metres and back.

Everything inside, and every topic, is SI. Millimetres appear in NIfTI and CSV files, in reports, and in parameters
whose names end in ``_mm``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

MM_PER_M = 1000.0


def mm_to_m(value_mm: ArrayLike) -> NDArray[np.float64]:
    """Millimetres to metres, elementwise."""
    return np.asarray(value_mm, dtype=np.float64) / MM_PER_M


def m_to_mm(value_m: ArrayLike) -> NDArray[np.float64]:
    """Metres to millimetres, elementwise."""
    return np.asarray(value_m, dtype=np.float64) * MM_PER_M


def m3_to_ml(volume_m3: ArrayLike) -> NDArray[np.float64]:
    """Cubic metres to millilitres, elementwise."""
    return np.asarray(volume_m3, dtype=np.float64) * 1e6


def affine_mm_to_m(affine_mm: ArrayLike) -> NDArray[np.float64]:
    """Convert a 4x4 voxel-to-world affine in millimetres to metres: all of its first three rows scale."""
    affine = np.array(affine_mm, dtype=np.float64)
    affine[:3] /= MM_PER_M
    return affine


def affine_m_to_mm(affine_m: ArrayLike) -> NDArray[np.float64]:
    """Inverse of :func:`affine_mm_to_m`."""
    affine = np.array(affine_m, dtype=np.float64)
    affine[:3] *= MM_PER_M
    return affine

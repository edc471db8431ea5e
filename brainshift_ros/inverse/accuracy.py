"""Measures of agreement between measured and estimated displacements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def shift_correction_percent(measured: NDArray[np.float64], estimated: NDArray[np.float64]) -> float | None:
    """Shift correction (4.4): ``(1 - mean |error| / mean |shift|) * 100``; None where nothing moved.

    Parameters
    ----------
    measured, estimated
        Shape (n, 3), displacements.
    """
    shift = float(np.mean(np.linalg.norm(measured, axis=1))) if len(measured) else 0.0
    if shift == 0.0:
        return None
    return (1.0 - float(np.mean(np.linalg.norm(measured - estimated, axis=1))) / shift) * 100.0


def angles_deg(measured: NDArray[np.float64], estimated: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (k,) between displacements, shape (n, 3) each, where both are non-zero."""
    lengths = np.linalg.norm(measured, axis=1) * np.linalg.norm(estimated, axis=1)
    moving = lengths > 0.0
    cosine = np.sum(measured[moving] * estimated[moving], axis=1) / lengths[moving]
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def angular_error_deg(measured: NDArray[np.float64], estimated: NDArray[np.float64]) -> float | None:
    """Mean angle between displacements where both are non-zero; None where there are none."""
    angles = angles_deg(measured, estimated)
    return float(angles.mean()) if angles.size else None

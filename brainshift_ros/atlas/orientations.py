"""Head orientations: directions of gravity spread over a cone around the planned one."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.geometry import tangent_frame, unit

#: Turn from one direction to the next, 137.5 degrees: no two line up, whatever their number.
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def directions_in_cone(axis: ArrayLike, half_angle: float, count: int) -> NDArray[np.float64]:
    """Fill a cone evenly with unit vectors: Vogel's spiral on the spherical cap.

    Equal steps of height on a sphere cut off equal areas (Archimedes), so the density is uniform. The first is the axis
    itself; the last lies on the rim, since an atlas serves a true orientation outside its extent badly (thesis, fig. 27).

    Parameters
    ----------
    axis
        The planned direction, shape (3,).
    half_angle
        Of the cone, radians.
    count
        How many, at least one.

    Returns
    -------
    Shape (count, 3).
    """
    index = np.arange(count)
    along = 1.0 - (1.0 - np.cos(half_angle)) * index / max(count - 1, 1)
    across = np.sqrt(np.maximum(0.0, 1.0 - along**2))
    turn = GOLDEN_ANGLE * index
    first, second, third = tangent_frame(axis)
    spread = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    return unit(along[:, None] * third + across[:, None] * spread)

"""Heights along "up", against gravity, as fractions of the head's extent."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError


def unit_direction(gravity_direction: ArrayLike) -> NDArray[np.float64]:
    """Check a gravity direction and scale it to length one.

    Raises
    ------
    InputError
        It is not three finite numbers, or zero.
    """
    direction = np.asarray(gravity_direction, dtype=np.float64)
    length = float(np.linalg.norm(direction)) if direction.shape == (3,) else np.nan
    if not (np.isfinite(length) and length > 0.0):
        raise InputError("gravity direction", f"is {direction.tolist()}", "give three finite numbers, not all zero")
    return direction / length


def height_over_level(nodes: NDArray[np.float64], gravity_direction: ArrayLike, level: float) -> NDArray[np.float64]:
    """Signed height of each node over a level plane, m.

    Parameters
    ----------
    nodes
        Shape (N, 3), m: the whole head, since its lowest and highest node define the levels 0 and 1.
    gravity_direction
        Where gravity pulls.
    level
        Height of the plane as a fraction of the head's extent along up.

    Raises
    ------
    InputError
        The direction or the level is not finite, or the direction is zero.
    """
    if not np.isfinite(level):
        raise InputError("level", f"is {level}", "give a fraction of the head's extent along up, 0 to 1")
    height = -(nodes @ unit_direction(gravity_direction))
    lowest, highest = height.min(), height.max()
    return height - (lowest + level * (highest - lowest))

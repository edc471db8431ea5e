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


def checked_levels(levels: ArrayLike) -> NDArray[np.float64]:
    """Levels (k,) as an array.

    Raises
    ------
    InputError
        A level is not finite.
    """
    checked = np.asarray(levels, dtype=np.float64)
    if not np.isfinite(checked).all():
        problem = f"is {checked[~np.isfinite(checked)][0]}"
        raise InputError("level", problem, "give a fraction of the head's extent along up, 0 to 1")
    return checked


def heights_over_levels(
    nodes: NDArray[np.float64], up: NDArray[np.float64], levels: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """:func:`height_over_level` of points (n, 3) for k unit vectors, the columns of `up` (3, k), and levels (k,): (n, k)."""
    height = nodes @ up
    # Interpolated so, the levels 0 and 1 are exactly the lowest and the highest node's.
    return points @ up - ((1.0 - levels) * height.min(axis=0) + levels * height.max(axis=0))


def height_over_level(
    nodes: NDArray[np.float64], gravity_direction: ArrayLike, level: float, points: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Signed height over a level plane, m.

    Parameters
    ----------
    nodes
        Shape (N, 3), m: the whole head, since its lowest and highest node define the levels 0 and 1.
    gravity_direction
        Where gravity pulls.
    level
        Height of the plane as a fraction of the head's extent along up.
    points
        Shape (n, 3), m: whose height is asked; the head's nodes themselves if None.

    Returns
    -------
    Shape (n,).

    Raises
    ------
    InputError
        The direction or the level is not finite, or the direction is zero.
    """
    up = -unit_direction(gravity_direction)[:, None]
    return heights_over_levels(nodes, up, checked_levels([level]), nodes if points is None else points)[:, 0]

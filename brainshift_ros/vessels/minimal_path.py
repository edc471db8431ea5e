"""Minimal paths along vessels between given ends (semi-automatic tracing, thesis fig. 55)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.graph import MCP_Geometric

#: Vesselness of a clear vessel: contrast in logarithmic intensity.
CLEAR_STRENGTH = 0.12

_MOST = 3.0  # a dark vein beside a thin artery must not be worth a long detour


def trace_between(
    strength: NDArray[np.float32], start: tuple[int, int], end: tuple[int, int], *, off_vessel: float = 0.08
) -> NDArray[np.float64]:
    """Cheapest path between two pixels, where the cost of a pixel falls with its vesselness.

    Parameters
    ----------
    strength
        Shape (H, W), vesselness.
    start, end
        (row, column), in the picture.
    off_vessel
        A pixel off any vessel costs about 1 / `off_vessel` times one on a clear vessel.

    Returns
    -------
    pixels
        Shape (n, 2), (row, column), from start to end, neighbours at most a diagonal step apart.
    """
    cost = 1.0 / (off_vessel + np.minimum(strength / CLEAR_STRENGTH, _MOST))
    search = MCP_Geometric(cost)
    search.find_costs([start], [end])
    return np.array(search.traceback(end), dtype=np.float64)

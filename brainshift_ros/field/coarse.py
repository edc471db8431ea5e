"""Sample a smooth function of space on a fine grid: exactly at every few voxels, linearly between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.image.grid import Grid
from brainshift_ros.parallel import threaded


def sampled_coarsely(function: Callable[[NDArray[np.float64]], NDArray], grid: Grid, spacing: float) -> NDArray[np.float32]:
    """Values of a vector function at the voxel centres of a grid, shape (I, J, K, C).

    Parameters
    ----------
    function
        Takes points (n, 3), metres, and gives (n, C).
    grid
        Any affine.
    spacing
        About how far apart, metres, the samples may lie; where voxels are as large, each is a sample.
    """
    steps = np.maximum(np.rint(spacing / grid.voxel_edges), 1).astype(int)
    counts = -(-(np.array(grid.shape) - 1) // steps) + 1
    corners = np.moveaxis(np.indices(tuple(counts)), 0, -1) * steps
    values = function(grid.centres(corners).reshape(-1, 3)).astype(np.float32).reshape(*counts, -1)
    for axis in (2, 1, 0):  # the longest stretches of memory last
        values = _refined(values, axis, int(steps[axis]), grid.shape[axis])
    return values


def _refined(values: NDArray[np.float32], axis: int, step: int, size: int) -> NDArray[np.float32]:
    """Linear interpolation between samples `step` apart along an axis, to `size` values."""
    if step == 1:
        return values
    samples = np.moveaxis(values, axis, 0)
    fine = np.empty(((len(samples) - 1) * step + 1, *samples.shape[1:]), dtype=np.float32)
    fine[-1] = samples[-1]
    shares = (np.arange(step, dtype=np.float32) / step).reshape(-1, *[1] * (samples.ndim - 1))

    def between(first: int) -> None:
        stretch = fine[first * step : (first + 1) * step]
        np.multiply(shares, samples[first + 1] - samples[first], out=stretch)
        stretch += samples[first]

    for _ in threaded(between, range(len(samples) - 1)):
        pass
    return np.moveaxis(fine[:size], 0, axis)

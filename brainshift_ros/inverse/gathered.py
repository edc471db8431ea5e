"""Measured points, gathered to a few where there are many: neighbours tell the uncertainty almost the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from brainshift_ros.units import mm_to_m

#: More points than this are gathered: the cost of conditioning grows with the cube.
_MOST = 32

#: Edge of the smallest cells that points are gathered in, metres, and the factor to the next larger ones.
_CELL, _GROWTH = float(mm_to_m(4.0)), 1.25


@dataclass(frozen=True)
class GatheredPoints:
    """Means of the points in each cell of a grid, or the points themselves if they are few.

    Attributes
    ----------
    positions
        Shape (n, 3), metres.
    rows
        Shape (3 n, m), the atlas at the points, metres per unit weight.
    displacements
        Shape (3 n,), metres.
    noise
        Shape (n, n), covariance of a component of the displacements over the points, metres squared.
    """

    positions: NDArray[np.float64]
    rows: NDArray[np.float64]
    displacements: NDArray[np.float64]
    noise: NDArray[np.float64]


def gather(
    positions: NDArray[np.float64], M: NDArray[np.float64], displacements: NDArray[np.float64], noise: NDArray[np.float64]
) -> GatheredPoints:
    """Gather measured points.

    Parameters
    ----------
    positions, displacements
        Shape (n, 3), metres.
    M
        Shape (n, 3, m), the atlas at the points.
    noise
        Shape (n,), standard deviation of a displacement component, metres; or (n, n), its covariance over the points.
    """
    n, _, m = M.shape
    if n > _MOST:
        mean = _means(positions, 1.0 / (noise**2 if noise.ndim == 1 else np.diagonal(noise)))
    else:
        mean = sparse.eye_array(n, format="csr")
    covariance = mean @ (sparse.diags_array(noise**2) if noise.ndim == 1 else noise) @ mean.T
    if sparse.issparse(covariance):
        covariance = covariance.toarray()
    rows = (mean @ M.reshape(n, 3 * m)).reshape(-1, m)
    return GatheredPoints(mean @ positions, rows, (mean @ displacements).reshape(-1), covariance)


def _means(positions: NDArray[np.float64], weight: NDArray[np.float64]) -> sparse.csr_array:
    """Matrix (k, n) of the weighted means over cells, of the smallest size that leaves few enough."""
    edge = _CELL
    while True:
        cell = np.floor((positions - positions.min(axis=0)) / edge).astype(np.int64)
        _, owner = np.unique(cell, axis=0, return_inverse=True)
        count = int(owner.max()) + 1
        if count <= _MOST:
            break
        edge *= _GROWTH
    owner = owner.ravel()
    share = weight / np.bincount(owner, weight)[owner]
    return sparse.csr_array((share, (owner, np.arange(len(positions)))), shape=(count, len(positions)))

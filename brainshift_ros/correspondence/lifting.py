"""From the plane to 3-D: local quadratic fits of the height beat the scanner's range noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_RADIUS_M = 1.8e-3
_LEAST_SEEN = 0.2  # of the disc


def lift(
    height: NDArray[np.float32], at: NDArray[np.float64], cell_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Height at sub-cell positions by a weighted quadratic fit over a disc of 1.8 mm.

    Parameters
    ----------
    height
        Height over the plane, metres, NaN where unseen.
    at
        Shape (n, 2), (column, row) in cells.
    cell_m
        Cell size, metres.

    Returns
    -------
    points
        Shape (n, 3), metres, in the plane's coordinates; NaN where too little was seen.
    noise
        Shape (n,), standard deviation of the fitted height, metres.
    """
    reach = int(np.ceil(_RADIUS_M / cell_m))
    points, noise = np.full((len(at), 3), np.nan), np.full(len(at), np.nan)
    middle = np.rint(at).astype(int)
    inside = np.flatnonzero(((middle >= 0) & (middle < np.array(height.shape[::-1]))).all(axis=1))
    if len(inside) == 0:
        return points, noise
    at, middle = at[inside], middle[inside]
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    padded = np.pad(height.astype(np.float64), reach, constant_values=np.nan)
    z = padded[middle[:, 1:] + reach + v, middle[:, :1] + reach + u]
    x, y = ((offset + (middle - at)[:, k, None]) * (cell_m / _RADIUS_M) for k, offset in enumerate((u, v)))
    squared = x**2 + y**2
    use = np.isfinite(z) & (squared < 1.0)
    weight = np.where(use, np.sqrt(np.maximum(1.0 - 0.8 * squared, 0.0)), 0.0)
    z = np.where(use, z, 0.0) * weight
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1) * weight[..., None]
    inverse = np.linalg.inv(np.einsum("nki,nkj->nij", design, design) + 1e-9 * np.eye(6))
    coefficients = np.einsum("nij,nkj,nk->ni", inverse, design, z, optimize=True)
    count = use.sum(axis=1)
    misfit = np.sum((z - np.einsum("nkj,nj->nk", design, coefficients)) ** 2, axis=1)
    # Cells were blurred over about 3 x 3 cells: that many fewer are independent.
    variance = 6.0 * misfit / np.maximum(count - 6, 1) * inverse[:, 0, 0]
    enough = (count > _LEAST_SEEN * np.pi * reach**2) & (variance > 0)
    index = inside[enough]
    points[index] = np.column_stack([at * cell_m, coefficients[:, 0]])[enough]
    noise[index] = np.sqrt(variance[enough])
    return points, noise

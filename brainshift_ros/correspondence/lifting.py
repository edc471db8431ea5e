"""From the plane to 3-D: local quadratic fits of the height beat the scanner's range noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_RADIUS_M = 1.8e-3


def lift(
    height: NDArray[np.float32], at: NDArray[np.float64], cell_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
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
    slope
        Shape (n,), steepness of the surface.
    noise
        Shape (n,), standard deviation of the fitted height, metres.
    """
    reach = int(np.ceil(_RADIUS_M / cell_m))
    points, slope, noise = np.full((len(at), 3), np.nan), np.full(len(at), np.nan), np.full(len(at), np.nan)
    offsets = np.arange(-reach, reach + 1)
    padded = np.pad(height.astype(np.float64), reach + 1, constant_values=np.nan)
    for k, (column, row) in enumerate(at):
        c, r = round(column), round(row)
        if not (0 <= c < height.shape[1] and 0 <= r < height.shape[0]):
            continue
        window = padded[r + 1 : r + 2 * reach + 2, c + 1 : c + 2 * reach + 2]
        x, y = np.meshgrid((offsets + c - column) * cell_m, (offsets + r - row) * cell_m)
        distance = np.hypot(x, y)
        use = np.isfinite(window) & (distance < _RADIUS_M)
        if use.sum() < 0.35 * np.pi * reach**2:
            continue
        x, y, z = x[use] / _RADIUS_M, y[use] / _RADIUS_M, window[use]
        weight = np.sqrt(1.0 - 0.8 * (distance[use] / _RADIUS_M) ** 2)
        design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1) * weight[:, None]
        normal = design.T @ design
        coefficients = np.linalg.solve(normal + 1e-9 * np.eye(6), design.T @ (weight * z))
        residual = weight * z - design @ coefficients
        # Cells were blurred over about 3 x 3 cells: that many fewer are independent.
        variance = 6.0 * float(residual @ residual) / max(len(z) - 6, 1)
        points[k] = column * cell_m, row * cell_m, coefficients[0]
        slope[k] = float(np.hypot(coefficients[1], coefficients[2])) / _RADIUS_M
        noise[k] = float(np.sqrt(variance * np.linalg.inv(normal + 1e-9 * np.eye(6))[0, 0]))
    return points, slope, noise

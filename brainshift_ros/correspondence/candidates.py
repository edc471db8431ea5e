"""Where homologous points are worth looking for: two-dimensional structure on vessels, spread over the cortex."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.plane_view import PlaneView
from brainshift_ros.vessels.vesselness import vesselness

_SPREAD_M = 6e-3
_RIM_M = 0.8e-3
_VESSEL = 0.02  # vesselness, of a texture scaled by _TEXTURE
_TEXTURE = 0.15
_LEAST_CLEAR = 0.75  # of the window
_LATTICE_M = 0.6e-3
_LEAST_SHARE = 0.01  # of a clear corner's strength


def choose_candidates(
    view: PlaneView, region: NDArray[np.bool_], cell_m: float, *, window_m: float, spacing_m: float, most: int
) -> NDArray[np.float64]:
    """Branches, bends and crossings of vessels, strongest first, at least a spacing apart.

    Parameters
    ----------
    view
        Texture of the cortex.
    region
        Cells to choose from.
    cell_m
        Cell size, metres.
    window_m
        Side of the window that will be matched around each; it lies in the region, and mostly on clear cells.
    spacing_m
        Least distance, metres.
    most
        How many at most.

    Returns
    -------
    candidates
        Shape (n, 2), (column, row), cells.
    """
    strength = vesselness(view.texture * _TEXTURE, cell_m)
    window = 2 * round(0.5 * window_m / cell_m) + 1
    corner = cv2.cornerMinEigenVal(cv2.GaussianBlur(view.texture, (0, 0), 0.35e-3 / cell_m), window, ksize=3)
    on_vessel = cv2.dilate((strength > _VESSEL).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    # The rim hides and bares cortex as it moves.
    border = 2 * round((0.5 * window_m + _RIM_M) / cell_m) + 1
    inner = cv2.erode(region.astype(np.uint8), np.ones((border, border), np.uint8)) > 0
    share = cv2.blur(view.clear.astype(np.float32), (window, window), borderType=cv2.BORDER_CONSTANT)
    corner = np.where(on_vessel & inner & view.clear & (share > _LEAST_CLEAR), corner, np.float32(0.0))
    if corner.max() <= 0:
        return np.zeros((0, 2))
    corner[corner < _LEAST_SHARE * np.quantile(corner[corner > 0], 0.99)] = 0.0
    # Strength is judged against the surroundings, so that a bundle of vessels does not take all the points.
    corner = corner / np.sqrt(cv2.GaussianBlur(corner, (0, 0), _SPREAD_M / cell_m) + 1e-12)
    # Any place in a strong neighbourhood will do: a lattice of them is quicker to go through than all cells.
    step = max(1, round(_LATTICE_M / cell_m))
    rows, columns = (step * index for index in np.nonzero(corner[::step, ::step]))
    order = np.argsort(-corner[rows, columns], kind="stable")
    return spaced(np.stack([columns[order], rows[order]], axis=-1).astype(np.float64), corner.shape, spacing_m / cell_m)[:most]


def spaced(at: NDArray[np.float64], shape: tuple[int, int], spacing: float) -> NDArray[np.float64]:
    """Those of the points (n, 2), (column, row), that lie no nearer than `spacing` cells to an earlier one of them."""
    free = np.ones(shape, dtype=np.uint8)
    chosen = []
    for k, (column, row) in enumerate(np.rint(at).astype(int)):
        if 0 <= row < shape[0] and 0 <= column < shape[1] and free[row, column]:
            chosen.append(k)
            cv2.circle(free, (int(column), int(row)), int(np.ceil(spacing)), 0, -1)
    return at[chosen]

"""What is not cortex in a view: metal, drape and bone by colour, blood by its extent, broken edges by height.

Their cells take no part in a match, and no point starts or ends on them. The rim of a cavity is both broken and bloody, so it
is left out with the cavity.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.plane_view import PlaneImage

_CELL_M = 0.4e-3
_DARK_LEVEL = 8.0
_DARKEST = 14.0  # red below this (of 255) has no colour to speak of
_PALE = 0.17  # less red than cortex, in log(red / green): metal -0.36, drape -1.1; shaded cortex -0.10
_BLOODY = 0.30  # more red than cortex: vessels and blood
_WIDEST_VESSEL_M = 3.0e-3
_SIGNIFICANT = 0.4  # of the highest peak of the histogram
_LAMP = 0.4  # by how much another lamp or exposure may redden the cortex; blood is redder by 0.9 or more
_JUMP_M, _JUMP_REACH_M = 4.0e-3, 0.8e-3  # steeper than 54 degrees across 1.6 mm
_MARGIN_M = 0.5e-3


@dataclass(frozen=True)
class Obstacles:
    """What hides or is not cortex in a view.

    Attributes
    ----------
    cells
        Shape of the grid: cells that do not show cortex, or show a broken edge.
    cortex_redness
        Mode of log(red / green) of the cortex under this scan's lamp; NaN where nothing of it was seen.
    """

    cells: NDArray[np.bool_]
    cortex_redness: float


def find_obstacles(
    image: PlaneImage, opening: NDArray[np.bool_], cell_m: float, first_redness: float = float("nan")
) -> Obstacles:
    """Find the cells of a view that do not show cortex, or show a broken edge.

    Parameters
    ----------
    image
        Colour and height over the plane grid.
    opening
        Cells in which much of what is seen is cortex: where the first scan's cortex is, for a later scan too, since the
        opening in the skull stays. The colour of cortex under this scan's lamp is learnt there.
    cell_m
        Cell size, metres.
    first_redness
        `cortex_redness` of the first scan, for a later one: blood that covers much of the opening is not taken for cortex.
    """
    factor = min(1.0, cell_m / _CELL_M)
    cell = cell_m / factor
    size = (max(1, round(opening.shape[1] * factor)), max(1, round(opening.shape[0] * factor)))
    color = cv2.resize(image.color, size, interpolation=cv2.INTER_AREA)
    matte = cv2.resize(image.matte.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    inside = cv2.resize(opening.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    height = np.asarray(cv2.resize(image.height, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32)

    redness = np.log((color[..., 0] + _DARK_LEVEL) / (color[..., 1] + _DARK_LEVEL))
    lit = matte & (color[..., 0] > _DARKEST)
    known = inside & lit
    if not known.any():
        return Obstacles(np.ones(opening.shape, dtype=bool), float("nan"))
    of_cortex = _reddest_peak(redness[known], first_redness + _LAMP)
    redness -= of_cortex
    pale = lit & (redness < -_PALE)
    bloody = cv2.morphologyEx((lit & (redness > _BLOODY)).astype(np.uint8), cv2.MORPH_OPEN, _disc(0.5 * _WIDEST_VESSEL_M, cell))
    broken = _height_range(height, _disc(_JUMP_REACH_M, cell)) > _JUMP_M
    obstacles = cv2.dilate((pale | (bloody > 0) | broken).astype(np.uint8), _disc(_MARGIN_M, cell)) > 0
    cells = cv2.resize((obstacles | (matte & ~lit)).astype(np.uint8), opening.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return Obstacles(cells, of_cortex)


def _disc(radius_m: float, cell_m: float) -> NDArray[np.uint8]:
    size = 2 * max(1, round(radius_m / cell_m)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def _reddest_peak(redness: NDArray[np.float32], reddest: float) -> float:
    """Mode of the colour of cortex: instruments that cover much of it are paler, and what is above `reddest` is blood."""
    width = 0.02
    bins = np.arange(-1.5, 2.5, width)
    kept = redness[~(redness > reddest)]  # a limit that is not known is NaN, and none
    count = np.convolve(np.histogram(kept, bins)[0], np.hanning(7), mode="same")
    peaks = (count >= _SIGNIFICANT * count.max()) & (count >= np.roll(count, 1)) & (count > np.roll(count, -1))
    return float(bins[np.flatnonzero(peaks)[-1]] + 0.5 * width) if peaks.any() else float(np.median(redness))


def _height_range(height: NDArray[np.float32], around: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Highest minus lowest of what is seen around each cell."""
    seen = np.isfinite(height)
    highest = cv2.dilate(np.where(seen, height, np.float32(-1e3)), around)
    lowest = cv2.erode(np.where(seen, height, np.float32(1e3)), around)
    return np.asarray(np.where(highest > lowest, highest - lowest, 0.0), dtype=np.float32)

"""A smooth shift in the plane through scattered ones: affine plus a smoothing thin-plate spline (Bookstein 1989)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

_UNIT_M = 10e-3  # lengths are scaled, so that the smoothing means the same on every grid
_LATTICE_M = 2.5e-3
_LEAST_FOR_SPLINE = 8
_COARSE_SMOOTHING = 0.02


@dataclass(frozen=True)
class SmoothField:
    """Shift in the plane, cells, as a function of place, (column, row) in cells.

    Attributes
    ----------
    spline
        From scaled places (n, 2) to shifts (n, 2) in cells.
    cell_m
        Cell size, metres.
    """

    spline: RBFInterpolator
    cell_m: float

    def __call__(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shift at places (n, 2), cells."""
        return np.asarray(self.spline(at * (self.cell_m / _UNIT_M)))

    def over(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Shift over a whole grid, shape (rows, columns, 2): exact on a lattice of 2.5 mm, bilinear between."""
        step = max(1, round(_LATTICE_M / self.cell_m))
        # The lattice lies so that `resize`, whose weights are exact, lands on the cells; it reaches over all four edges.
        u, v = np.meshgrid(*(step * (np.arange(-1, -(-extent // step) + 1) + 0.5) - 0.5 for extent in shape[::-1]))
        lattice = self(np.stack([u.ravel(), v.ravel()], axis=-1)).reshape(*u.shape, 2).astype(np.float32)
        size = (lattice.shape[1] * step, lattice.shape[0] * step)
        fine = cv2.resize(lattice, size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(fine[step : step + shape[0], step : step + shape[1]], dtype=np.float32)


def fit_field(
    places: NDArray[np.float64], shift: NDArray[np.float64], cell_m: float, smoothing: float | NDArray[np.float64]
) -> SmoothField:
    """Fit a smooth field.

    Parameters
    ----------
    places, shift
        Shape (n, 2), cells; n >= 3, not all on one line.
    cell_m
        Cell size, metres.
    smoothing
        Weight of the bending energy against the misfit, in units of (10 mm)^2; one number or one for each place.
    """
    spline = RBFInterpolator(places * (cell_m / _UNIT_M), shift, kernel="thin_plate_spline", degree=1, smoothing=smoothing)
    return SmoothField(spline, cell_m)


def field_through(places: NDArray[np.float64], later: NDArray[np.float64], cell_m: float) -> SmoothField:
    """Field through rough pairs of places (n, 2) in cells: a similarity through few, a smoothing spline through more."""
    if len(places) >= _LEAST_FOR_SPLINE:
        return fit_field(places, later - places, cell_m, _COARSE_SMOOTHING)
    similar = fit_similarity(places, later)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) * (_UNIT_M / cell_m) + places.mean(axis=0)
    return fit_field(corners, corners @ similar[:, :2].T + similar[:, 2] - corners, cell_m, 0.0)


def fit_similarity(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least-squares rotation, scale and shift of the plane (Umeyama 1991), shape (2, 3), from points (n, 2), n >= 2.

    The scale is held to 0.8 to 1.25: the cortex does not stretch more over a craniotomy.
    """
    a, b = (points[:, 0] + 1j * points[:, 1] for points in (source, target))
    a0, b0 = a.mean(), b.mean()
    factor = np.vdot(a - a0, b - b0) / max(np.vdot(a - a0, a - a0).real, 1e-12)
    factor *= np.clip(abs(factor), 0.8, 1.25) / max(abs(factor), 1e-12)
    offset = b0 - factor * a0
    return np.array([[factor.real, -factor.imag, offset.real], [factor.imag, factor.real, offset.imag]])

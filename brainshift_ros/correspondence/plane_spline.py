"""Thin-plate splines of a displacement over the plane of the craniotomy, as linear operators on what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError

LEAST_POINTS = 4
_FLATTEST = 0.02  # extent across over extent along, below which points lie on a line
_SMOOTHING = tuple(float(value) for value in np.logspace(-5.0, 0.0, 11))
_LARGEST_MISFIT = 5.0  # standard deviations at which a residual stops to count more


@dataclass(frozen=True)
class Plane:
    """Coordinates along the principal plane of points, scaled to about one.

    Attributes
    ----------
    center
        Shape (3,), metres.
    axes
        Shape (2, 3), unit vectors.
    scale_m
        Length of one unit, metres.
    """

    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    scale_m: float

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Plane coordinates, shape (n, 2), of points (n, 3)."""
        return (points - self.center) @ self.axes.T / self.scale_m


def plane_of(points: NDArray[np.float64]) -> Plane:
    """Principal plane of points (n, 3), metres.

    Raises
    ------
    InputError
        Fewer than four points, or points on a line.
    """
    source = "homologous points"
    if len(points) < LEAST_POINTS:
        raise InputError(source, f"{len(points)} points", f"a dense field needs at least {LEAST_POINTS}, not on a line")
    center = points.mean(axis=0)
    _, extent, axes = np.linalg.svd(points - center, full_matrices=False)
    if not extent[1] > _FLATTEST * extent[0]:
        raise InputError(source, "they lie on a line", "add points beside it")
    return Plane(center, axes[:2], float(extent[0] / np.sqrt(len(points))))


@dataclass(frozen=True)
class PlaneSpline:
    """A smoothing thin-plate spline; how smooth, measured points decide by leaving each out in turn.

    Attributes
    ----------
    plane
        Where it lives.
    xy
        Shape (n, 2), plane coordinates of the measured points.
    stiffness
        Shape (n,), the smoothing of each point, in proportion to its variance.
    """

    plane: Plane
    xy: NDArray[np.float64]
    stiffness: NDArray[np.float64]

    def weights(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shape (m, n): each row, applied to measured values, gives the spline's value at one of the points (m, 3)."""
        return self._weights_at(self.plane(at))

    def without(self, left_out: NDArray[np.bool_]) -> PlaneSpline:
        """Return the spline of the other points, no less smooth."""
        return PlaneSpline(self.plane, self.xy[~left_out], self.stiffness[~left_out])

    def _weights_at(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        unit = np.eye(len(self.xy))
        spline = RBFInterpolator(self.xy, unit, smoothing=self.stiffness, kernel="thin_plate_spline", degree=1)
        return np.asarray(spline(xy), dtype=np.float64)


def fit_spline(measured: HomologousPoints) -> PlaneSpline:
    """Choose the smoothing by leave-one-out cross-validation.

    A linear smoother's prediction of a point from all the others needs no refit: its residual over 1 - H_ii, H being the
    operator at the measured points themselves (Wahba 1990).

    Raises
    ------
    InputError
        Fewer than four points, or points on a line.
    """
    plane = plane_of(measured.points)
    xy = plane(measured.points)
    variance = (measured.sigma / np.median(measured.sigma)) ** 2
    best, chosen = np.inf, PlaneSpline(plane, xy, _SMOOTHING[-1] * variance)
    for smoothing in _SMOOTHING:
        spline = PlaneSpline(plane, xy, smoothing * variance)
        own = spline._weights_at(xy)
        left_out = (measured.displacements - own @ measured.displacements) / np.maximum(1.0 - np.diag(own), 1e-6)[:, None]
        misfit = np.minimum((left_out / measured.sigma[:, None]) ** 2, _LARGEST_MISFIT**2).mean()
        if misfit < best:
            best, chosen = float(misfit), spline
    return chosen

"""Dense displacement over the craniotomy by thin-plate splines, with a covariance that knows where nothing was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree
from scipy.spatial.distance import cdist

from brainshift_ros.correspondence.error_growth import ErrorGrowth, fit_error_growth
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.correspondence.plane_spline import fit_spline
from brainshift_ros.errors import InputError
from brainshift_ros.units import m_to_mm

_LEAST_OWN = 0.3  # of a point's sigma


@dataclass(frozen=True)
class DenseField:
    """Interpolated displacements.

    Attributes
    ----------
    points, displacements
        Shape (m, 3), metres, in the frame of the measured points.
    sigma
        Shape (m,), standard deviation of each displacement component, metres: error of the interpolation at its distance
        and measurement noise carried through the spline.
    distance_m
        Shape (m,), distance to the nearest measured point.
    growth
        How the interpolation's error grows with that distance.
    weights
        Shape (m, n), the spline as an operator on the n measured displacements.
    measured_sigma
        Shape (n,), metres: the part of each measured point's standard deviation that is its own.
    common_m
        The part of it that all points share, metres.
    warnings
        What a person should know.
    """

    points: NDArray[np.float64]
    displacements: NDArray[np.float64]
    sigma: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    growth: ErrorGrowth
    weights: NDArray[np.float64]
    measured_sigma: NDArray[np.float64]
    common_m: float
    warnings: tuple[str, ...]

    def covariance(self, model_sigma_m: float = 0.0) -> NDArray[np.float64]:
        """Covariance of one displacement component, shape (m, m), metres squared: what (8.5) inverts.

        Interpolation errors of neighbours are alike (an exponential in their distance), noise is as correlated as the spline
        makes it, and what all points share is.

        Parameters
        ----------
        model_sigma_m
            Standard deviation of what a model that is fitted to the field cannot follow, metres: the residual of (8.6) is not
            the measurement's alone. Without it, closely spaced points bind the model to details of the spline.
        """
        grown = self.growth.sigma(self.distance_m)
        alike = np.exp(-cdist(self.points, self.points) / self.growth.correlation_m)
        noise = self.weights * self.measured_sigma
        return (
            np.outer(grown, grown) * alike + noise @ noise.T + self.common_m**2 + np.diag(np.full(len(grown), model_sigma_m**2))
        )

    def as_points(self) -> HomologousPoints:
        """All dense points with their own standard deviations, as if they were independent: (8.3) with a diagonal W."""
        return HomologousPoints(self.points, self.displacements, self.sigma)

    def as_independent_points(self) -> HomologousPoints:
        """Points for a solver that knows no correlation.

        Each standard deviation is raised by the square root of how many points' worth of correlation it shares (the row sum
        of the correlation matrix), so that together they weigh as much as the covariance allows and no more.
        """
        correlation = self.covariance() / np.outer(self.sigma, self.sigma)
        shared = np.maximum(np.abs(correlation).sum(axis=1), 1.0)
        return HomologousPoints(self.points, self.displacements, self.sigma * np.sqrt(shared))


def interpolate(
    points: HomologousPoints,
    at: NDArray[np.float64],
    growth: ErrorGrowth | None = None,
    vessel_ids: NDArray[np.intp] | None = None,
    *,
    common_m: float = 0.0,
) -> DenseField:
    """Interpolate measured displacements by a thin-plate spline over the plane of the craniotomy.

    Parameters
    ----------
    points
        Homologous points, at least four.
    at
        Shape (m, 3), metres, where the displacement is wanted: the cortex before its shift, same frame.
    growth
        How the error grows with distance; fitted to left-out groups of `points` if None.
    vessel_ids
        Shape (n,), which vessel each point lies on, for that fit.
    common_m
        The part of every point's sigma that all points share, metres: the tracker's error, which no spline averages out and
        no left-out point shows.

    Raises
    ------
    InputError
        Too few points, points on a line, or `at` of another shape or not finite.
    """
    at = np.asarray(at, dtype=np.float64)
    if at.ndim != 2 or at.shape[1] != 3 or len(at) == 0 or not np.isfinite(at).all():
        raise InputError(
            "dense field", f"positions of shape {at.shape} or not finite", "give at least one point, (m, 3), metres"
        )
    own = np.sqrt(np.maximum(points.sigma**2 - common_m**2, (_LEAST_OWN * points.sigma) ** 2))
    local = HomologousPoints(points.points, points.displacements, own)
    spline = fit_spline(local)
    growth = growth or fit_error_growth(local, vessel_ids, spline)
    weights = spline.weights(at)
    distance = cKDTree(points.points).query(at)[0]
    sigma = np.sqrt(growth.sigma(distance) ** 2 + weights**2 @ own**2 + common_m**2)
    outside = Delaunay(spline.xy).find_simplex(spline.plane(at)) < 0
    return DenseField(
        points=at,
        displacements=weights @ points.displacements,
        sigma=sigma,
        distance_m=distance,
        growth=growth,
        weights=weights,
        measured_sigma=own,
        common_m=common_m,
        warnings=growth.warnings + _warnings(distance, outside, growth),
    )


def _warnings(distance: NDArray[np.float64], outside: NDArray[np.bool_], growth: ErrorGrowth) -> tuple[str, ...]:
    warnings = []
    if outside.any():
        warnings.append(
            f"{100 * outside.mean():.0f} % of the dense points lie outside the measured ones, "
            f"up to {m_to_mm(distance[outside].max()):.0f} mm from the nearest: extrapolated"
        )
    beyond = distance > growth.farthest_m
    if growth.farthest_m > 0.0 and beyond.any():
        warnings.append(
            f"{100 * beyond.mean():.0f} % of the dense points lie farther from a measured one than the "
            f"{m_to_mm(growth.farthest_m):.0f} mm that their standard deviations were fitted to"
        )
    return tuple(warnings)

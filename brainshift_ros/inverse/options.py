"""Settings of the inverse model."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InverseOptions:
    """Settings of :func:`brainshift_ros.inverse.estimate.estimate_shift`.

    Attributes
    ----------
    method
        A name in :data:`brainshift_ros.inverse.methods.METHODS`.
    max_outside_mm
        Measured points farther than this outside the mesh are dropped.
    outlier_sigmas
        A point is an outlier if its residual exceeds this many robust standard deviations.
    min_points
        With fewer points in use the estimate is not valid.
    max_residual_fraction
        With a mean residual above this fraction of the mean shift the estimate is not valid...
    max_residual_sigmas
        ...unless the mean residual is within this many standard deviations of the measurement.
    max_kkt_residual
        With a larger KKT residual the solver failed and the estimate is not valid.
    """

    method: str = "constrained"
    max_outside_mm: float = 5.0
    outlier_sigmas: float = 4.5
    min_points: int = 5
    max_residual_fraction: float = 0.5
    max_residual_sigmas: float = 3.0
    max_kkt_residual: float = 1e-6

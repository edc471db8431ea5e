"""Settings of the registration."""

from __future__ import annotations

from dataclasses import dataclass, field

from brainshift_ros.registration.candidates import Stage
from brainshift_ros.registration.verdict import Gates


@dataclass(frozen=True)
class RegistrationOptions:
    """Settings of the registration and gates of its verdict.

    Attributes
    ----------
    spacing_mm
        Spacing of the scan's points.
    lattice_mm, lattice_radius_mm, lattice_turns_deg
        Starts around a given pose: their spacing and how far they reach along the surface, and turns about its normal.
    lattice_stages
        How these starts are narrowed down to a few places.
    search_mm, search_turn_deg
        Starts of a search without a pose: spacing over the cortex and angle between turns about its normal.
    search_stages
        How these starts are narrowed down.
    score_mm
        Distance to the cortex at which a point no longer speaks for a place.
    distinct_mm
        Places closer than this (mean over the scan's points) are one.
    rival_ratio
        A place that scores this share of the best is a rival.
    fine_mm
        Largest correspondence distance, and Tukey's constant, of each fine stage.
    iterations
        Most iterations of a fine stage.
    inlier_mm
        A point nearer than this to the cortex (along its normal) is an inlier.
    surface_bias_mm
        Standard deviation of the MR surface's common offset along its normals: a part of a voxel that segmentation puts to
        one side everywhere. It enters the covariance.
    gates
        Limits of the verdict.
    """

    spacing_mm: float = 1.0
    lattice_mm: float = 5.0
    lattice_radius_mm: float = 10.0
    lattice_turns_deg: tuple[float, ...] = (-24.0, -12.0, 0.0, 12.0, 24.0)
    lattice_stages: tuple[Stage, ...] = (Stage(120, 12.0, 6, 24), Stage(300, 8.0, 6, 8), Stage(800, 4.0, 8, 4))
    search_mm: float = 13.0
    search_turn_deg: float = 20.0
    search_stages: tuple[Stage, ...] = (
        Stage(50, 12.0, 3, 2000),
        Stage(100, 12.0, 4, 200),
        Stage(300, 8.0, 6, 24),
        Stage(800, 4.0, 8, 6),
    )
    score_mm: float = 2.0
    distinct_mm: float = 3.0
    rival_ratio: float = 0.9
    fine_mm: tuple[float, ...] = (3.0, 1.5)
    iterations: int = 30
    inlier_mm: float = 1.5
    surface_bias_mm: float = 0.3
    gates: Gates = field(default_factory=Gates)

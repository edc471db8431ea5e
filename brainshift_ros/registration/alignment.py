"""Where a patch fits the cortex best: many starts narrowed down to places, and the best place refined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.registration.candidates import Candidates, narrow
from brainshift_ros.registration.following import following_region, plane_residuals
from brainshift_ros.registration.icp import robust_icp
from brainshift_ros.registration.lattice import lattice_around
from brainshift_ros.registration.options import RegistrationOptions
from brainshift_ros.registration.patch import ScanPatch
from brainshift_ros.registration.search import SearchArea, poses_over
from brainshift_ros.registration.target import CortexTarget
from brainshift_ros.units import mm_to_m


@dataclass(frozen=True)
class Places:
    """Distinct places where a scan fits, best first, and from how many starts they were reached."""

    candidates: Candidates
    starts: int


def places_around(
    patch: ScanPatch, target: CortexTarget, T_patient_tracker: NDArray[np.float64], options: RegistrationOptions
) -> Places:
    """Start on a lattice around a given pose."""
    cloud = patch.cloud()
    starts = lattice_around(
        T_patient_tracker,
        cloud,
        spacing_m=float(mm_to_m(options.lattice_mm)),
        radius_m=float(mm_to_m(options.lattice_radius_mm)),
        turns_deg=options.lattice_turns_deg,
    )
    found = narrow(cloud, target, starts, options.lattice_stages, score_mm=options.score_mm, distinct_mm=options.distinct_mm)
    return Places(found, len(starts))


def places_over(patch: ScanPatch, target: CortexTarget, near: SearchArea | None, options: RegistrationOptions) -> Places:
    """Start everywhere in an area, or all over the exposed cortex."""
    cloud = patch.cloud()
    starts = poses_over(target, cloud, near, spacing_m=float(mm_to_m(options.search_mm)), turn_deg=options.search_turn_deg)
    found = narrow(cloud, target, starts, options.search_stages, score_mm=options.score_mm, distinct_mm=options.distinct_mm)
    return Places(found, len(starts))


def refine(
    patch: ScanPatch, target: CortexTarget, T_patient_tracker: NDArray[np.float64], options: RegistrationOptions
) -> tuple[NDArray[np.float64], int]:
    """Refine a pose in fine stages; return it and its iterations.

    After the first stage only what follows the cortex takes part: dura and instruments lie off it by millimetres, and would
    pull the pose along by tenths.
    """
    T, total = T_patient_tracker, 0
    where = patch.oriented
    for distance_mm in options.fine_mm:
        fit = robust_icp(patch.cloud(where), target, T, float(mm_to_m(distance_mm)), options.iterations)
        T, total = fit.T_patient_tracker, total + fit.iterations
        residual = plane_residuals(target, patch, T)
        where = following_region(residual, patch.oriented, patch.spacing_m, float(mm_to_m(options.inlier_mm)))
    return T, total

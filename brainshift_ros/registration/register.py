"""Register the first scan to the cortical surface: robust ICP from many starts, and a verdict that asks for more than that."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.registration.alignment import places_around, places_over, refine
from brainshift_ros.registration.checks import check_scan
from brainshift_ros.registration.handedness import handedness_fault
from brainshift_ros.registration.opening import opening_mask
from brainshift_ros.registration.options import RegistrationOptions
from brainshift_ros.registration.patch import scan_patch
from brainshift_ros.registration.result import RegistrationResult
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.registration.search import SearchArea
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.registration.verdict import judge
from brainshift_ros.surface.surface import Surface
from brainshift_ros.timing import timed
from brainshift_ros.units import m_to_mm, mm_to_m

_LARGE_CORRECTION_MM = 12.0
_NEAR_POSE_M = 30e-3
_LEAST_POINTS = 100


def register_scan(
    scan: OrganisedScan,
    cortex: Surface | CortexTarget,
    T_patient_tracker_initial: NDArray[np.float64] | None,
    options: RegistrationOptions | None = None,
    *,
    near: SearchArea | None = None,
) -> RegistrationResult:
    """Register a scan to the cortical surface by robust ICP from many starts, coarse to fine.

    Parameters
    ----------
    scan
        First scan after the dura is opened, tracker frame.
    cortex
        The patient's cortex, or its prepared target (:func:`prepare_target`), which saves seconds a call.
    T_patient_tracker_initial
        4x4, from a tracked pose or landmarks, within about 15 degrees and 10 mm. None: search for the place.
    options
        Settings and gates.
    near
        Where a search looks, such as the planned craniotomy; all over the exposed cortex by default. A scan that looks
        mirrored is looked for there too.

    Returns
    -------
    RegistrationResult
        Also when refused: then `reasons` says why.

    Raises
    ------
    InputError
        When the scan is unusable, the initial pose is not a rigid transform, or the search area holds no cortex.

    Notes
    -----
    Starts around the given pose, or all over the area, end at a few distinct places. If another place fits nearly as well
    as the best, the result is refused.
    """
    options = options or RegistrationOptions()
    times: dict[str, float] = {}
    with timed(times, "prepare"):
        check_scan(scan)
        initial = None if T_patient_tracker_initial is None else check_pose(T_patient_tracker_initial)
        target = cortex if isinstance(cortex, CortexTarget) else prepare_target(cortex)
        patch = scan_patch(scan, opening_mask(scan), float(mm_to_m(options.spacing_mm)))
        cloud = patch.cloud()
        if len(cloud.points) < _LEAST_POINTS:
            raise InputError("scan", "its points are too scattered over the picture", "send a dense organised scan")
        middle = cloud.points.mean(axis=0)
    with timed(times, "coarse"):
        if initial is None:
            places = places_over(patch, target, near, options)
        else:
            places = places_around(patch, target, initial, options)
    with timed(times, "fine"):
        T, iterations = refine(patch, target, places.candidates.poses[0], options)
    with timed(times, "verdict"):
        judged = judge(
            patch,
            target,
            T,
            inlier_m=float(mm_to_m(options.inlier_mm)),
            surface_bias_m=float(mm_to_m(options.surface_bias_mm)),
            rivals=places.candidates.rivals(options.rival_ratio),
            shape=scan.points.shape[:2],
        )
        reasons = options.gates.failures(judged.evidence)
        warnings = []
        if not reasons and initial is not None:
            correction_mm = float(m_to_mm(np.linalg.norm(transform_points(T, middle) - transform_points(initial, middle))))
            if correction_mm > _LARGE_CORRECTION_MM:
                warnings.append(f"registration moved the scan by {correction_mm:.0f} mm from its initial pose: check the pose")
        elif reasons:
            fault = handedness_fault(patch, target, _where_to_look(near, initial, middle, target), options)
            reasons = reasons if fault is None else (fault, *reasons)
    return RegistrationResult(
        T_patient_tracker=T,
        accepted=not reasons,
        reasons=reasons,
        evidence=judged.evidence,
        covariance=judged.covariance,
        pivot=judged.pivot,
        start="search" if initial is None else "pose",
        starts=places.starts,
        iterations=iterations,
        cortex_mask=judged.cortex_mask & scan.seen,
        warnings=tuple(warnings),
        times_s=times,
    )


def _where_to_look(
    near: SearchArea | None, initial: NDArray[np.float64] | None, middle: NDArray[np.float64], target: CortexTarget
) -> SearchArea | None:
    """Around the given pose, unless it lays the scan beside the cortex, as that of a mirrored tracker space does."""
    if near is not None or initial is None:
        return near
    area = SearchArea(transform_points(initial, middle), _NEAR_POSE_M)
    return area if target.tree.query(area.center)[0] < area.radius_m else None


def check_pose(T_patient_tracker: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose as a float64 array; raise InputError when it is not a rigid transform."""
    T = np.asarray(T_patient_tracker, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError("initial pose", f"shape {T.shape} or not finite", "give a finite 4x4 transform")
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0 or not np.allclose(T[3], [0, 0, 0, 1]):
        raise InputError(
            "initial pose", "not a rigid transform (scaled, sheared or mirrored)", "give a rotation and a translation"
        )
    if np.linalg.norm(T[:3, 3]) > 20.0:
        raise InputError("initial pose", f"translation of {np.linalg.norm(T[:3, 3]):.0f} m", "give it in metres")
    return T

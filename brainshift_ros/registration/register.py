"""Register the first scan to the cortical surface: robust point-to-plane ICP and a verdict that does not trust convergence."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import tangent_frame, transform_points
from brainshift_ros.registration.checks import check_scan
from brainshift_ros.registration.icp import IcpFit, robust_icp, tukey_weight
from brainshift_ros.registration.opening import opening_mask
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.registration.thinning import voxel_means
from brainshift_ros.registration.verdict import Evidence, Gates, judge, plane_residuals, skew
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm, mm_to_m


@dataclass(frozen=True)
class RegistrationOptions:
    """Settings of the registration and gates of its verdict.

    Attributes
    ----------
    voxels_mm
        Spacing of the scan's points at each stage.
    distances_mm
        Largest correspondence distance at each stage; Tukey's constant is the same.
    iterations
        Most iterations at each stage.
    restart_mm
        How far the four restarts are moved along the surface, to see whether another place fits as well.
    inlier_mm
        A point nearer than this to the cortex (along its normal) is an inlier.
    gates
        Limits of the verdict.
    """

    voxels_mm: tuple[float, ...] = (4.0, 2.5, 1.2)
    distances_mm: tuple[float, ...] = (10.0, 5.0, 2.5)
    iterations: tuple[int, ...] = (40, 40, 30)
    restart_mm: float = 6.0
    inlier_mm: float = 1.5
    gates: Gates = field(default_factory=Gates)


@dataclass(frozen=True)
class RegistrationResult:
    """Where the tracker is in the patient, and whether to believe it.

    Attributes
    ----------
    T_patient_tracker
        4x4 rigid transform.
    accepted
        The verdict: every gate passed.
    reasons
        Which gates failed, in words; empty when accepted.
    evidence
        The figures that the verdict rests on.
    covariance
        Shape (6, 6): rotation vector (rad), then translation (m), patient frame, about `pivot`; from the Hessian.
    pivot
        Shape (3,), centroid of the inliers, patient frame, metres.
    iterations
        ICP iterations of the chosen start, all stages.
    cortex_mask
        Shape (H, W): the scan's pixels that lie on the cortex.
    warnings
        What a person should know although the verdict stands.
    times_s
        Seconds by stage.
    """

    T_patient_tracker: NDArray[np.float64]
    accepted: bool
    reasons: tuple[str, ...]
    evidence: Evidence
    covariance: NDArray[np.float64]
    pivot: NDArray[np.float64]
    iterations: int
    cortex_mask: NDArray[np.bool_]
    warnings: tuple[str, ...]
    times_s: Mapping[str, float]

    @property
    def inlier_fraction(self) -> float:
        """Share of inliers among the scan's points inside the outline of the matched cortex."""
        return self.evidence.inlier_fraction

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the inliers to the cortex along its normals, metres."""
        return self.evidence.rms_m

    @property
    def condition(self) -> float:
        """Condition number of the Hessian, rotations scaled by the patch's radius of gyration."""
        return self.evidence.condition

    def predicted_tre_m(self, target: ArrayLike) -> float:
        """Predict the registration error at a target, metres: root of the trace of its covariance.

        Parameters
        ----------
        target
            Shape (3,), patient frame, metres.
        """
        lever = np.asarray(target, dtype=np.float64) - self.pivot
        jacobian = np.concatenate([-skew(lever), np.eye(3)], axis=1)
        return float(np.sqrt(np.trace(jacobian @ self.covariance @ jacobian.T)))


def register_scan(
    scan: OrganisedScan,
    cortex: Surface | CortexTarget,
    T_patient_tracker_initial: NDArray[np.float64] | None,
    options: RegistrationOptions | None = None,
) -> RegistrationResult:
    """Register a scan to the cortical surface by robust point-to-plane ICP, coarse to fine.

    Parameters
    ----------
    scan
        First scan after the dura is opened, tracker frame.
    cortex
        The patient's cortex, or its prepared target (:func:`prepare_target`), which saves seconds a call.
    T_patient_tracker_initial
        4x4, from a tracked pose or landmarks, within about 15 degrees and 10 mm.
    options
        Settings and gates.

    Returns
    -------
    RegistrationResult
        Also when refused: then `reasons` says why.

    Raises
    ------
    InputError
        When the scan is unusable, or there is no initial pose, or it is not a rigid transform.

    Notes
    -----
    Restarts from four places beside the given start end either at the same pose, or at a worse fit, or show that the
    surface slides: then the result is refused.
    """
    options = options or RegistrationOptions()
    clock = time.perf_counter()
    check_scan(scan)
    initial = check_pose(T_patient_tracker_initial)
    target = cortex if isinstance(cortex, CortexTarget) else prepare_target(cortex)
    opening = opening_mask(scan)
    points = scan.points[opening].astype(np.float64)
    clouds = [voxel_means(points, float(mm_to_m(voxel)))[0] for voxel in options.voxels_mm]
    times = {"prepare": time.perf_counter() - clock}

    clock = time.perf_counter()
    stages = list(zip(options.distances_mm, options.iterations, strict=True))
    middle = transform_points(initial, points.mean(axis=0))
    starts = [initial, *_moved_starts(initial, middle, target, float(mm_to_m(options.restart_mm)))]
    coarse = [_through_stages(clouds[:-1], stages[:-1], target, start) for start in starts]
    finest_m = float(mm_to_m(options.distances_mm[-1]))
    scores = [_fit_score(clouds[0], target, fit.T_patient_tracker, finest_m) for fit in coarse]
    best = int(np.argmax(scores))
    fine = _through_stages(clouds[-1:], stages[-1:], target, coarse[best].T_patient_tracker)
    T = fine.T_patient_tracker
    ends = [transform_points(fit.T_patient_tracker, clouds[0]) for fit in coarse]
    moved = [float(np.linalg.norm(end - ends[best], axis=1).mean()) for end in ends]
    # A rival fits nearly as well at another place; coarse stages settle to about a millimetre.
    rivals = sum(score > 0.93 * scores[best] and distance > 2e-3 for score, distance in zip(scores, moved, strict=True))
    times["icp"] = time.perf_counter() - clock

    clock = time.perf_counter()
    judged = judge(scan, opening, target, T, inlier_m=float(mm_to_m(options.inlier_mm)), rivals=rivals)
    reasons = options.gates.failures(judged.evidence)
    warnings = []
    correction_mm = float(m_to_mm(np.linalg.norm(transform_points(T, points.mean(axis=0)) - middle)))
    if not reasons and correction_mm > 12.0:
        warnings.append(f"registration moved the scan by {correction_mm:.0f} mm from its initial pose: check the pose")
    times["verdict"] = time.perf_counter() - clock
    return RegistrationResult(
        T_patient_tracker=T,
        accepted=not reasons,
        reasons=reasons,
        evidence=judged.evidence,
        covariance=judged.covariance,
        pivot=judged.pivot,
        iterations=coarse[best].iterations + fine.iterations,
        cortex_mask=judged.cortex_mask,
        warnings=tuple(warnings),
        times_s=times,
    )


def check_pose(T_patient_tracker: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the pose as a float64 array; raise InputError when it is missing or not a rigid transform."""
    if T_patient_tracker is None:
        raise InputError(
            "initial pose", "none was given", "send a tracked or landmark-based pose before or after the first scan"
        )
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


def _moved_starts(
    T: NDArray[np.float64], middle: NDArray[np.float64], target: CortexTarget, step_m: float
) -> list[NDArray[np.float64]]:
    """Move the pose by `step_m` to four sides along the surface."""
    _, near = target.tree.query(middle, k=400)
    normal = target.normals[near].mean(axis=0)
    tangents = tangent_frame(normal if np.linalg.norm(normal) > 0 else [0.0, 0.0, 1.0])[:2]
    starts = []
    for shift in (*tangents, *-tangents):
        moved = T.copy()
        moved[:3, 3] += step_m * shift
        starts.append(moved)
    return starts


def _through_stages(
    clouds: list[NDArray[np.float64]], stages: list[tuple[float, int]], target: CortexTarget, T: NDArray[np.float64]
) -> IcpFit:
    """ICP through stages of (correspondence distance in mm, most iterations), one cloud each."""
    total = 0
    for cloud, (distance_mm, iterations) in zip(clouds, stages, strict=True):
        fit = robust_icp(cloud, target, T, float(mm_to_m(distance_mm)), iterations)
        T, total = fit.T_patient_tracker, total + fit.iterations
    return IcpFit(T, total)


def _fit_score(cloud: NDArray[np.float64], target: CortexTarget, T: NDArray[np.float64], distance_m: float) -> float:
    """Mean Tukey weight of the scan's points: near 1 where everything fits."""
    residual = plane_residuals(target, transform_points(T, cloud), distance_m)
    return float(np.mean(tukey_weight(np.nan_to_num(residual, nan=distance_m), distance_m)))

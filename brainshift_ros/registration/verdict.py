"""Whether a registration is to be believed: inliers, residual, relief, conditioning, rivals. Convergence is not asked."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import transform_points
from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.registration.target import CortexTarget
from brainshift_ros.units import m_to_mm

_JUDGED_POINTS = 15_000
# Errors of an MR surface are alike over about a gyrus: neighbouring points are not independent evidence.
_CORRELATION_M = 6e-3


@dataclass(frozen=True)
class Evidence:
    """Figures of the fit.

    Attributes
    ----------
    inlier_fraction
        Share of inliers among the scan's points inside the outline of the matched cortex.
    rms_m
        Root mean square of the inliers' distance to the cortex along its normals, metres.
    area_m2
        Area of the inliers, square metres.
    condition
        Condition number of the Hessian, rotations scaled by the patch's radius of gyration.
    relief_ratio
        Residual to the cortex over residual to the best smooth (quadratic) surface. Near one or above: the scan has no
        relief, or the cortex at this place has another, and nothing holds the scan against sliding.
    rivals
        Restarts that fit nearly as well at another place.
    """

    inlier_fraction: float
    rms_m: float
    area_m2: float
    condition: float
    relief_ratio: float
    rivals: int


@dataclass(frozen=True)
class Gates:
    """Limits that all must hold."""

    min_inlier_fraction: float = 0.9
    max_rms_mm: float = 0.62
    min_area_cm2: float = 8.0
    max_condition: float = 300.0
    max_relief_ratio: float = 0.55
    max_rivals: int = 0

    def failures(self, evidence: Evidence) -> tuple[str, ...]:
        """Each failed gate in words, with the figure and the limit."""
        area_cm2, rms_mm = evidence.area_m2 * 1e4, float(m_to_mm(evidence.rms_m))
        inliers, relief = evidence.inlier_fraction, evidence.relief_ratio
        checks = (
            (
                area_cm2 >= self.min_area_cm2,
                f"only {area_cm2:.1f} cm2 of it meet the cortex (least: {self.min_area_cm2:g})",
            ),
            (
                inliers >= self.min_inlier_fraction,
                f"only {inliers:.0%} of the points in the opening meet the cortex (least: {self.min_inlier_fraction:.0%})",
            ),
            (rms_mm <= self.max_rms_mm, f"the inliers' RMS distance is {rms_mm:.2f} mm (most: {self.max_rms_mm:g} mm)"),
            (
                evidence.condition <= self.max_condition,
                f"the surface does not hold the scan: condition number {evidence.condition:.3g} (most: {self.max_condition:g})",
            ),
            (
                relief <= self.max_relief_ratio,
                f"the gyri do not match: residual {relief:.2f} of a smooth surface's (most: {self.max_relief_ratio:g})",
            ),
            (evidence.rivals <= self.max_rivals, f"{evidence.rivals} other places fit nearly as well"),
        )
        return tuple(text for passed, text in checks if not passed)


@dataclass(frozen=True)
class Judgement:
    """Evidence, the covariance about a pivot, and the scan's pixels on the cortex."""

    evidence: Evidence
    covariance: NDArray[np.float64]
    pivot: NDArray[np.float64]
    cortex_mask: NDArray[np.bool_]


def skew(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross-product matrix: ``skew(v) @ w == cross(v, w)``."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def plane_residuals(target: CortexTarget, points: NDArray[np.float64], within_m: float) -> NDArray[np.float64]:
    """Signed distance of points (n, 3), patient frame, to the nearest cortex point's plane; NaN beyond `within_m`."""
    distance, index = target.tree.query(points, distance_upper_bound=within_m)
    found = np.isfinite(distance)
    residual = np.full(len(points), np.nan)
    near = index[found]
    residual[found] = np.einsum("ij,ij->i", points[found] - target.points[near], target.normals[near])
    return residual


def _smooth_residual_rms(points: NDArray[np.float64]) -> float:
    """RMS distance of points to the quadratic height surface over their principal plane."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    z, x, y = (centred @ axes).T
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    coefficients, *_ = np.linalg.lstsq(design, z, rcond=None)
    return float(np.sqrt(np.mean((z - design @ coefficients) ** 2)))


def judge(
    scan: OrganisedScan,
    opening: NDArray[np.bool_],
    target: CortexTarget,
    T_patient_tracker: NDArray[np.float64],
    *,
    inlier_m: float,
    rivals: int,
) -> Judgement:
    """Gather the evidence for a pose.

    Parameters
    ----------
    scan, opening
        The scan and its pixels that look like cortex.
    target
        The cortex.
    T_patient_tracker
        The pose to judge.
    inlier_m
        Distance of an inlier, metres.
    rivals
        How many restarts fit nearly as well elsewhere.
    """
    stride = max(1, int(np.sqrt(max(opening.sum(), 1) / _JUDGED_POINTS)))
    points = transform_points(T_patient_tracker, scan.points[::stride, ::stride].astype(np.float64))
    candidates = opening[::stride, ::stride]
    residual = np.full(candidates.shape, np.nan)
    residual[candidates] = plane_residuals(target, points[candidates], 4e-3)
    inlier = np.abs(residual) < inlier_m  # NaN compares false
    spacing = pixel_spacing(scan) * stride

    region = _largest_region(inlier, spacing)
    outline = np.zeros(inlier.shape, dtype=np.uint8)
    contours, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if contours:
        cv2.fillConvexPoly(outline, cv2.convexHull(np.concatenate(contours)), 1)
    within = (outline > 0) & candidates
    used = inlier & region
    if used.sum() < 30:
        nothing = Evidence(0.0, float("inf"), 0.0, float("inf"), float("inf"), rivals)
        return Judgement(nothing, np.eye(6), points[candidates].mean(axis=0), np.zeros(scan.seen.shape, dtype=bool))

    at = points[used]
    rms = float(np.sqrt(np.mean(residual[used] ** 2)))
    pivot = at.mean(axis=0)
    _, index = target.tree.query(at)
    normals = target.normals[index]
    jacobian = np.concatenate([np.cross(at - pivot, normals), normals], axis=1)
    information = jacobian.T @ jacobian
    gyration = float(np.sqrt(np.mean(np.sum((at - pivot) ** 2, axis=1))))
    scale = np.diag([1 / gyration] * 3 + [1.0] * 3)
    values = np.linalg.eigvalsh(scale @ information @ scale)
    condition = float(values[-1] / max(values[0], 1e-12 * values[-1]))
    area = float(used.sum()) * spacing**2
    independent = max(area / _CORRELATION_M**2, 1.0)
    covariance = np.linalg.pinv(information) * rms**2 * max(len(at) / independent, 1.0)
    evidence = Evidence(
        inlier_fraction=float(used.sum() / max(within.sum(), 1)),
        rms_m=rms,
        area_m2=area,
        condition=condition,
        relief_ratio=rms / max(_smooth_residual_rms(at), 1e-6),
        rivals=rivals,
    )
    height, width = scan.seen.shape
    mask = cv2.resize(region.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return Judgement(evidence, covariance, pivot, mask & scan.seen)


def _largest_region(inlier: NDArray[np.bool_], spacing_m: float) -> NDArray[np.bool_]:
    """Largest connected part of the inliers, dropouts and glints bridged."""
    size = 2 * max(1, round(1.5e-3 / spacing_m)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    closed = cv2.morphologyEx(np.pad(inlier.astype(np.uint8), size), cv2.MORPH_CLOSE, disc)[size:-size, size:-size]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
    if count < 2:
        return np.zeros_like(inlier)
    return labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))

"""Whether a registration is to be believed: inliers, residual, relief, conditioning, scale, rivals; not convergence."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import transform_points
from brainshift_ros.registration.following import disc, following_region, plane_residuals
from brainshift_ros.registration.icp import tukey_weight
from brainshift_ros.registration.patch import ScanPatch
from brainshift_ros.registration.target import CortexTarget
from brainshift_ros.units import m_to_mm

# Errors of an MR surface are alike over about a gyrus: neighbouring points are not independent evidence.
_CORRELATION_M = 8e-3
_FOLD_M = 4e-3
_LEAST_BLOCKS = 30
_SCALED_POINTS, _SCALE_ITERATIONS = 1500, 10


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
        Area of the scan that follows the cortex, dropouts within it included, square metres.
    condition
        Condition number of the Hessian, rotations scaled by the patch's radius of gyration.
    relief_ratio
        Residual to the cortex over residual to the best smooth (quadratic) surface. Near one or above: the scan has no
        relief, or the cortex at this place has another, and nothing holds the scan against sliding.
    scale
        By what factor the scan would fit best; away from one it is in other units or not calibrated.
    scale_sigma
        Standard deviation of `scale`.
    rivals
        Other places that fit nearly as well.
    """

    inlier_fraction: float
    rms_m: float
    area_m2: float
    condition: float
    relief_ratio: float
    scale: float
    scale_sigma: float
    rivals: int


@dataclass(frozen=True)
class Gates:
    """Limits that all must hold."""

    min_inlier_fraction: float = 0.93
    max_rms_mm: float = 0.5
    min_area_cm2: float = 8.0
    max_condition: float = 300.0
    max_relief_ratio: float = 0.55
    max_scale_error: float = 0.04
    max_rivals: int = 0

    def failures(self, evidence: Evidence) -> tuple[str, ...]:
        """Each failed gate in words, with the figure and the limit."""
        if evidence.area_m2 == 0.0:
            return ("no part of it meets the cortex",)
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
            (
                abs(evidence.scale - 1.0) <= max(self.max_scale_error, 2.0 * evidence.scale_sigma),
                f"it would fit better scaled by {evidence.scale:.2f}: check the scanner's units and calibration",
            ),
            (evidence.rivals <= self.max_rivals, f"it fits nearly as well elsewhere ({evidence.rivals} other places)"),
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


def judge(
    patch: ScanPatch,
    target: CortexTarget,
    T_patient_tracker: NDArray[np.float64],
    *,
    inlier_m: float,
    surface_bias_m: float,
    rivals: int,
    shape: tuple[int, int],
) -> Judgement:
    """Gather the evidence for a pose.

    Parameters
    ----------
    patch
        The scan's blocks in the opening.
    target
        The cortex.
    T_patient_tracker
        The pose to judge.
    inlier_m
        Distance of an inlier, metres.
    surface_bias_m
        Standard deviation of the cortical surface's common offset along its normals, metres. No residual shows it, since
        the fit follows it.
    rivals
        How many other places fit nearly as well.
    shape
        (H, W) of the scan, for the mask.
    """
    residual = plane_residuals(target, patch, T_patient_tracker)
    region = following_region(residual, patch.oriented, patch.spacing_m, inlier_m)
    used = region & (np.abs(residual) < inlier_m)
    mask = np.zeros(shape, dtype=bool)
    if used.sum() < _LEAST_BLOCKS:
        nothing = Evidence(0.0, float("inf"), 0.0, float("inf"), float("inf"), 1.0, float("inf"), rivals)
        middle = transform_points(T_patient_tracker, np.nanmean(patch.points, axis=(0, 1)))
        return Judgement(nothing, np.eye(6), middle, mask)
    at = transform_points(T_patient_tracker, patch.points[used])
    normals = target.normals[target.tree.query(at)[1]]
    rms = float(np.sqrt(np.mean(residual[used] ** 2)))
    pivot = at.mean(axis=0)
    jacobian = np.concatenate([np.cross(at - pivot, normals), normals], axis=1)
    information = jacobian.T @ jacobian
    gyration = float(np.sqrt(np.mean(np.sum((at - pivot) ** 2, axis=1))))
    scaling = np.diag([1 / gyration] * 3 + [1.0] * 3)
    values = np.linalg.eigvalsh(scaling @ information @ scaling)
    # Residual variance for each independent piece of evidence, not for each block.
    repeats = max(min(_CORRELATION_M**2 / patch.spacing_m**2, len(at)), 1.0)
    variance = rms**2 * repeats
    outlined = _convex_hull(region) & patch.oriented
    scale, scale_sigma = _best_scale(at, target, inlier_m, variance)
    evidence = Evidence(
        inlier_fraction=float(used.sum() / max(outlined.sum(), 1)),
        rms_m=rms,
        area_m2=float(region.sum()) * patch.spacing_m**2,
        condition=float(values[-1] / max(values[0], 1e-12 * values[-1])),
        relief_ratio=rms / max(_smooth_residual_rms(at), 1e-6),
        scale=scale,
        scale_sigma=scale_sigma,
        rivals=rivals,
    )
    inverse = np.linalg.pinv(information)
    follows = inverse @ jacobian.sum(axis=0) * surface_bias_m
    covariance = inverse * variance + np.outer(follows, follows)
    # Folds that the model lacks are cortex too, if they look like it; dura and instruments lie above it.
    above = residual > inlier_m  # NaN compares false
    reached = cv2.dilate(region.astype(np.uint8), disc(round(_FOLD_M / patch.spacing_m))) > 0
    cortex = reached & ~above & np.isfinite(patch.points[..., 0])
    rows, columns = (size * patch.block for size in region.shape)
    mask[:rows, :columns] = np.kron(cortex, np.ones((patch.block, patch.block), dtype=bool))
    return Judgement(evidence, covariance, pivot, mask)


def _convex_hull(region: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Fill the convex hull of a region (h, w)."""
    contours, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    hull = np.zeros(region.shape, dtype=np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(contours)), 1)
    return hull > 0


def _smooth_residual_rms(points: NDArray[np.float64]) -> float:
    """RMS distance of points to the quadratic height surface over their principal plane."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    z, x, y = (centred @ axes).T
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    coefficients, *_ = np.linalg.lstsq(design, z, rcond=None)
    return float(np.sqrt(np.mean((z - design @ coefficients) ** 2)))


def _best_scale(points: NDArray[np.float64], target: CortexTarget, within_m: float, variance: float) -> tuple[float, float]:
    """Scale of the similarity transform that fits registered points (n, 3) best, by ICP, and its standard deviation.

    `variance` is that of an independent residual, over all of the points.
    """
    step = max(1, len(points) // _SCALED_POINTS)
    at, scale = points[::step], 1.0
    for _ in range(_SCALE_ITERATIONS):
        distance, index = target.tree.query(at, distance_upper_bound=2.0 * within_m)
        near = np.isfinite(distance)
        normals, offset = target.normals[index[near]], at[near] - target.points[index[near]]
        residual = np.einsum("ij,ij->i", offset, normals)
        pivot = at.mean(axis=0)
        lever = at[near] - pivot
        design = np.column_stack([np.cross(lever, normals), normals, np.einsum("ij,ij->i", lever, normals)])
        weighted = design * tukey_weight(residual, 2.0 * within_m)[:, None]
        information = weighted.T @ design
        change = -np.linalg.pinv(information) @ (weighted.T @ residual)
        turned = Rotation.from_rotvec(change[:3]).apply(at - pivot)
        at, scale = pivot + change[3:6] + (1.0 + change[6]) * turned, scale * (1.0 + change[6])
    return float(scale), float(np.sqrt(variance / step * np.linalg.pinv(information)[6, 6]))

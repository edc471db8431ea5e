"""Robust ICP from many starts at once: Gauss-Newton with Tukey's kernel, symmetric or point-to-plane.

Open3D's ICP builds the target's tree in every call and knows one start only; small_gicp's Python interface has no robust
kernel. Neither reports what the verdict needs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import rigid, transform_points
from brainshift_ros.registration.patch import OrientedPoints
from brainshift_ros.registration.target import CortexTarget

_SMALLEST_STEP = 1e-3  # of the correspondence distance
_AT_ONCE = 60_000  # points of all starts that are moved together: they stay in the cache


@dataclass(frozen=True)
class IcpFit:
    """A pose and how many iterations led to it."""

    T_patient_tracker: NDArray[np.float64]
    iterations: int


def tukey_weight(residual: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Tukey's biweight: 1 at zero, 0 from `scale` on."""
    return np.clip(1.0 - (residual / scale) ** 2, 0.0, 1.0) ** 2


def robust_icp(
    cloud: OrientedPoints,
    target: CortexTarget,
    T_patient_tracker: NDArray[np.float64],
    distance_m: float,
    iterations: int,
) -> IcpFit:
    """Refine one pose by point-to-plane ICP on exact nearest points (Chen and Medioni 1992).

    Parameters
    ----------
    cloud
        The scan, tracker frame.
    target
        The cortex.
    T_patient_tracker
        4x4, the start.
    distance_m
        Largest correspondence distance, and Tukey's constant, metres.
    iterations
        Most iterations.
    """
    T = T_patient_tracker.copy()
    for done in range(1, iterations + 1):
        moved = transform_points(T, cloud.points)
        distance, index = target.tree.query(moved, distance_upper_bound=distance_m)
        found = np.isfinite(distance)
        if found.sum() < 12:
            return IcpFit(T, done)
        at, near = moved[found], index[found]
        normals = target.normals[near]
        residual = np.einsum("ij,ij->i", at - target.points[near], normals)
        facing = np.einsum("ij,ij->i", cloud.normals[found] @ T[:3, :3].T, normals)
        weight = tukey_weight(residual, distance_m) * np.clip(facing, 0.0, 1.0)
        pivot, step = _gauss_newton(at[None], normals[None], residual[None], weight[None])
        rotation = Rotation.from_rotvec(step[0, :3])
        T = rigid(rotation, pivot[0] - rotation.apply(pivot[0]) + step[0, 3:]) @ T
        radius = float(np.sqrt(np.mean(np.sum((at - pivot[0]) ** 2, axis=1))))
        if np.linalg.norm(step[0, :3]) * radius + np.linalg.norm(step[0, 3:]) < _SMALLEST_STEP * distance_m:
            return IcpFit(T, done)
    return IcpFit(T, iterations)


def coarse_icp(
    cloud: OrientedPoints, target: CortexTarget, poses: NDArray[np.float64], distance_m: float, iterations: int
) -> NDArray[np.float64]:
    """Move many poses, shape (s, 4, 4), a few symmetric steps each (Rusinkiewicz 2019) on tabulated nearest points.

    The symmetric objective measures along the sum of both normals, so that a curved patch may slide along its own curvature
    without cost; points whose normals disagree with the cortex's weigh nothing, which keeps crowns off the walls of sulci.
    Both widen the basin.
    """
    chunk = max(1, _AT_ONCE // len(cloud.points))
    parts = [
        _coarse(cloud, target, poses[first : first + chunk], distance_m, iterations) for first in range(0, len(poses), chunk)
    ]
    return np.concatenate(parts)


def _coarse(
    cloud: OrientedPoints, target: CortexTarget, poses: NDArray[np.float64], distance_m: float, iterations: int
) -> NDArray[np.float64]:
    poses = poses.copy()
    for _ in range(iterations):
        at, normals, offset, cortex, inside = _corresponding(cloud, target, poses)
        facing = np.einsum("snk,snk->sn", normals, cortex)
        squared = np.einsum("snk,snk->sn", offset, offset)
        weight = inside * np.clip(1.0 - squared / distance_m**2, 0.0, 1.0) ** 2 * np.clip(facing, 0.0, 1.0) ** 2
        both = normals + cortex
        pivot, step = _gauss_newton(at, both, np.einsum("snk,snk->sn", offset, both), weight)
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        moved = poses[:, :3, 3] - pivot
        poses[:, :3, 3] = np.einsum("sij,sj->si", turn, moved) + pivot + step[:, 3:]
        poses[:, :3, :3] = turn @ poses[:, :3, :3]
    return poses


def fit_scores(
    cloud: OrientedPoints, target: CortexTarget, poses: NDArray[np.float64], distance_m: float
) -> NDArray[np.float64]:
    """How well each pose (s, 4, 4) fits, 0 to 1: mean Tukey weight of the points' distances times agreement of normals."""
    chunk = max(1, _AT_ONCE // len(cloud.points))
    scores = []
    for first in range(0, len(poses), chunk):
        _, normals, offset, cortex, inside = _corresponding(cloud, target, poses[first : first + chunk])
        along = np.einsum("snk,snk->sn", offset, cortex)
        near = inside & (np.einsum("snk,snk->sn", offset, offset) < (2.0 * distance_m) ** 2)
        agreement = np.clip(np.einsum("snk,snk->sn", normals, cortex), 0.0, 1.0)
        scores.append(np.mean(near * agreement * tukey_weight(along, distance_m), axis=1))
    return np.concatenate(scores)


def _corresponding(
    cloud: OrientedPoints, target: CortexTarget, poses: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return moved points and normals, offsets from the nearest cortex points and their normals, (s, n, 3); which are near."""
    rotation = poses[:, :3, :3].transpose(0, 2, 1)
    at = cloud.points @ rotation + poses[:, None, :3, 3]
    index = target.grid.lookup(at)
    return at, cloud.normals @ rotation, at - target.points[index], target.normals[index], index >= 0


def _gauss_newton(
    at: NDArray[np.float64], normals: NDArray[np.float64], residual: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pivots (s, 3), and steps (s, 6): rotation vectors about them and translations, from (s, n, ...) linearised residuals."""
    total = np.maximum(weight.sum(axis=1), 1e-9)
    pivot = np.einsum("sn,snk->sk", weight, at) / total[:, None]
    jacobian = np.concatenate([np.cross(at - pivot[:, None], normals), normals], axis=-1)
    weighted = (jacobian * weight[..., None]).transpose(0, 2, 1)
    # Levenberg's term keeps a flat patch from jumping along its own plane; rotations are scaled by a patch's 3 cm.
    damping = 1e-5 * total[:, None, None] * np.diag([1e-3] * 3 + [1.0] * 3) + 1e-12 * np.eye(6)
    step = np.linalg.solve(weighted @ jacobian + damping, -weighted @ residual[..., None])
    return pivot, step[..., 0]

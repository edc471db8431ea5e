"""Point-to-plane ICP with Tukey's kernel (Chen and Medioni 1992), Gauss-Newton on a tree that is built once.

Open3D's ICP builds the target's tree in every call, which costs more than the iterations here, and reports neither their
number nor the Hessian; small_gicp's Python interface has no robust kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import rigid, transform_points
from brainshift_ros.registration.target import CortexTarget

_SMALLEST_STEP = 1e-3  # of the correspondence distance


@dataclass(frozen=True)
class IcpFit:
    """A pose and how many iterations led to it."""

    T_patient_tracker: NDArray[np.float64]
    iterations: int


def tukey_weight(residual: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Tukey's biweight: 1 at zero, 0 from `scale` on."""
    return np.clip(1.0 - (residual / scale) ** 2, 0.0, 1.0) ** 2


def robust_icp(
    points: NDArray[np.float64],
    target: CortexTarget,
    T_patient_tracker: NDArray[np.float64],
    distance_m: float,
    iterations: int,
) -> IcpFit:
    """Refine a pose with one correspondence distance.

    Parameters
    ----------
    points
        Shape (n, 3), tracker frame, metres.
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
        moved = transform_points(T, points)
        distance, index = target.tree.query(moved, distance_upper_bound=distance_m)
        found = np.isfinite(distance)
        if found.sum() < 12:
            return IcpFit(T, done)
        at, near = moved[found], index[found]
        normals = target.normals[near]
        residual = np.einsum("ij,ij->i", at - target.points[near], normals)
        weight = tukey_weight(residual, distance_m)
        pivot = at.mean(axis=0)
        jacobian = np.concatenate([np.cross(at - pivot, normals), normals], axis=1)
        hessian = jacobian.T @ (jacobian * weight[:, None])
        # Levenberg's term keeps a flat patch from jumping along its own plane.
        damping = 1e-6 * np.trace(hessian[3:, 3:]) * np.diag([1e-3] * 3 + [1.0] * 3)
        step = np.linalg.solve(hessian + damping, -jacobian.T @ (weight * residual))
        rotation = Rotation.from_rotvec(step[:3])
        T = rigid(rotation, pivot - rotation.apply(pivot) + step[3:]) @ T
        radius = float(np.sqrt(np.mean(np.sum((at - pivot) ** 2, axis=1))))
        if np.linalg.norm(step[:3]) * radius + np.linalg.norm(step[3:]) < _SMALLEST_STEP * distance_m:
            return IcpFit(T, done)
    return IcpFit(T, iterations)

"""Starts around a given pose: moved along the surface and turned about its normal, the directions in which a patch slides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import rigid, tangent_frame, transform_points
from brainshift_ros.registration.patch import OrientedPoints


def lattice_around(
    T_patient_tracker: NDArray[np.float64],
    cloud: OrientedPoints,
    *,
    spacing_m: float,
    radius_m: float,
    turns_deg: tuple[float, ...],
) -> NDArray[np.float64]:
    """Poses (s, 4, 4) moved over a hexagonal lattice along the surface and turned about its normal; the given one is first.

    These three directions are the ones in which a patch slides; ICP finds the others from any start.
    """
    pivot = transform_points(T_patient_tracker, cloud.points.mean(axis=0))
    first, second, normal = tangent_frame(T_patient_tracker[:3, :3] @ cloud.normals.mean(axis=0))
    steps = int(radius_m / spacing_m) + 1
    a, b = (index.ravel() for index in np.mgrid[-2 * steps : 2 * steps + 1, -2 * steps : 2 * steps + 1])
    shifts = spacing_m * ((a + 0.5 * b)[:, None] * first + (np.sqrt(0.75) * b)[:, None] * second)
    length = np.linalg.norm(shifts, axis=1)
    shifts = shifts[length <= radius_m * (1 + 1e-9)]
    shifts = shifts[np.argsort(np.linalg.norm(shifts, axis=1), kind="stable")]
    poses = []
    for angle in sorted(turns_deg, key=abs):
        turn = Rotation.from_rotvec(np.deg2rad(angle) * normal)
        poses += [rigid(turn, pivot - turn.apply(pivot) + shift) @ T_patient_tracker for shift in shifts]
    return np.array(poses)

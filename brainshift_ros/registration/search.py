"""Starts of a search without a pose: the scan laid on the cortex everywhere in an area, turned every way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import tangent_frame, unit
from brainshift_ros.registration.patch import OrientedPoints
from brainshift_ros.registration.target import CortexTarget
from brainshift_ros.registration.thinning import voxel_means

_PATCH_RADIUS_M = 25e-3  # a craniotomy: over it the outward direction of the cortex is averaged
_HULL_SPACING_M = 5e-3


@dataclass(frozen=True)
class SearchArea:
    """A ball in which the middle of the scan is looked for: `center` (3,) and `radius_m`, patient frame, metres."""

    center: NDArray[np.float64]
    radius_m: float


def poses_over(
    target: CortexTarget, cloud: OrientedPoints, near: SearchArea | None, *, spacing_m: float, turn_deg: float
) -> NDArray[np.float64]:
    """Poses (s, 4, 4) that lay the cloud on the cortex all over an area, facing outward, at every turn about the normal.

    Raises
    ------
    InputError
        No cortex in the area.
    """
    places, outward = voxel_means(target.points, spacing_m, target.normals)
    if near is not None:
        inside = np.linalg.norm(places - near.center, axis=1) <= near.radius_m
        places, outward = places[inside], outward[inside]
        if len(places) == 0:
            raise InputError("search area", "holds no exposed cortex", "give its centre and radius in metres, patient frame")
    coarse, directions = voxel_means(target.points, _HULL_SPACING_M, target.normals)
    weight = np.linalg.norm(places[:, None] - coarse[None], axis=-1) < _PATCH_RADIUS_M
    outward = unit(outward + weight @ directions)
    middle, facing = cloud.points.mean(axis=0), tangent_frame(cloud.normals.mean(axis=0))
    angles = np.deg2rad(np.arange(0.0, 360.0, turn_deg))
    about_normal = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    poses = np.tile(np.eye(4), (len(places), len(angles), 1, 1))
    frames = np.array([tangent_frame(direction) for direction in outward])
    poses[..., :3, :3] = np.einsum("pji,ajk,kl->pail", frames, about_normal, facing)
    poses[..., :3, 3] = places[:, None] - poses[..., :3, :3] @ middle
    return poses.reshape(-1, 4, 4)

"""Rigid and affine transforms, always named ``T_<to>_<from>``, and the RAS/LPS flip."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

# ITK, DICOM and SimpleITK speak LPS+; NIfTI and this project RAS+. The flip is its own inverse.
T_LPS_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def transform_points(T_b_a: ArrayLike, points_a: ArrayLike) -> NDArray[np.float64]:
    """Map points, shape (..., 3), from frame a to frame b; NaN rows stay NaN."""
    T = np.asarray(T_b_a, dtype=np.float64)
    return np.asarray(points_a, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def invert_rigid(T_b_a: ArrayLike) -> NDArray[np.float64]:
    """T_a_b of a rigid transform, without the round-off of a general inverse."""
    T = np.asarray(T_b_a, dtype=np.float64)
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def rigid(rotation: Rotation, translation: ArrayLike) -> NDArray[np.float64]:
    """Build a 4x4 transform from a rotation and a translation in metres."""
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = np.asarray(translation, dtype=np.float64)
    return T


def unit(vector: ArrayLike) -> NDArray[np.float64]:
    """Vectors of shape (..., 3) scaled to length one; a zero vector raises ValueError."""
    v = np.asarray(vector, dtype=np.float64)
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    if np.any(length == 0.0):
        raise ValueError("a zero vector has no direction")
    return v / length


def tangent_frame(normal: ArrayLike) -> NDArray[np.float64]:
    """Rotation R (3x3) whose rows are two tangents and the unit normal: ``R @ x`` are local coordinates."""
    n = unit(normal)
    helper = np.eye(3)[np.argmin(np.abs(n))]
    first = unit(np.cross(n, helper))
    return np.stack([first, np.cross(n, first), n])

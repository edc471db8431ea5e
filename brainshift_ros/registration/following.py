"""Which part of a posed scan follows the cortex, and how far off it each block is."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import transform_points
from brainshift_ros.registration.patch import ScanPatch
from brainshift_ros.registration.target import CortexTarget

_WITHIN_M = 4e-3
_BRIDGED_M, _GAP_M = 1.5e-3, 4e-3


def plane_residuals(
    target: CortexTarget, patch: ScanPatch, T_patient_tracker: NDArray[np.float64], within_m: float = _WITHIN_M
) -> NDArray[np.float64]:
    """Signed distance, shape (h, w), metres, of the patch's blocks to the nearest cortex point's plane.

    NaN beyond `within_m`, and where scan and cortex face opposite ways.
    """
    residual = np.full(patch.points.shape[:2], np.nan)
    where = patch.oriented
    at = transform_points(T_patient_tracker, patch.points[where])
    distance, index = target.tree.query(at, distance_upper_bound=within_m)
    near = np.isfinite(distance)
    index = np.where(near, index, 0)
    facing = np.einsum("ij,ij->i", patch.normals[where] @ T_patient_tracker[:3, :3].T, target.normals[index]) > 0.0
    along = np.einsum("ij,ij->i", at - target.points[index], target.normals[index])
    residual[where] = np.where(near & facing, along, np.nan)
    return residual


def disc(reach: int) -> NDArray[np.uint8]:
    """Structuring element that reaches that many blocks."""
    size = 2 * reach + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def _closed(region: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Close gaps of a region (h, w) up to twice `reach` blocks wide, at least one."""
    reach = max(reach, 1)
    padded = np.pad(region.astype(np.uint8), reach)
    return np.asarray(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc(reach))[reach:-reach, reach:-reach] > 0)


def following_region(
    residual: NDArray[np.float64], oriented: NDArray[np.bool_], spacing_m: float, within_m: float
) -> NDArray[np.bool_]:
    """Largest connected part (h, w) of the blocks nearer than `within_m` to the cortex: dura and instruments are not in it.

    Small disagreeing patches are bridged, and so are larger gaps where nothing was seen (dropouts and glints): there is
    nothing in them that contradicts.
    """
    near = np.abs(residual) < within_m  # NaN compares false
    unseen = _closed(oriented, round(_GAP_M / spacing_m)) & ~oriented
    closed = (_closed(near, round(_BRIDGED_M / spacing_m)) | near | unseen).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    if count < 2:
        return np.zeros(residual.shape, dtype=bool)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))

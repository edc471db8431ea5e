"""Why a scan that bulges the wrong way was refused: a mirrored cloud, or a picture whose rows run backwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brainshift_ros.geometry import tangent_frame
from brainshift_ros.registration.alignment import places_over, refine
from brainshift_ros.registration.icp import tukey_weight
from brainshift_ros.registration.options import RegistrationOptions
from brainshift_ros.registration.patch import OrientedPoints, ScanPatch
from brainshift_ros.registration.search import SearchArea
from brainshift_ros.registration.target import CortexTarget
from brainshift_ros.registration.verdict import judge
from brainshift_ros.units import mm_to_m

_BULGE_PER_M = 2.0  # mean curvature; a cerebrum has 10 to 15
_ROBUST_M = 6e-3


def bulge(cloud: OrientedPoints) -> float:
    """Mean curvature of a cloud, 1/m, by a robust quadratic height surface: positive where it bulges to where it faces."""
    axes = tangent_frame(cloud.normals.mean(axis=0))
    x, y, z = ((cloud.points - cloud.points.mean(axis=0)) @ axes.T).T
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    root = np.ones_like(z)
    for _ in range(5):
        coefficients, *_ = np.linalg.lstsq(design * root[:, None], z * root, rcond=None)
        root = np.sqrt(tukey_weight(z - design @ coefficients, _ROBUST_M))
    return float(-coefficients[3] - coefficients[5])


def handedness_fault(
    patch: ScanPatch, target: CortexTarget, near: SearchArea | None, options: RegistrationOptions
) -> str | None:
    """Name what is mirrored in a refused scan, when undoing it makes the scan fit somewhere in the area.

    Parameters
    ----------
    patch
        The refused scan.
    target
        The cortex.
    near
        Where it may lie; anywhere by default.
    options
        As of the registration.

    Returns
    -------
    str or None
        The fault in words; None when the scan bulges towards the scanner as it should, or nothing fits.
    """
    if bulge(patch.cloud()) > _BULGE_PER_M:
        return None
    mirror = np.array([-1.0, 1.0, 1.0])
    # A reflection turns the grid's sense of rotation, and with it the side that its normals face.
    mirrored = replace(patch, points=patch.points * mirror, normals=-patch.normals * mirror)
    backwards = replace(patch, normals=-patch.normals)
    for fault, upright in (
        ("the cloud is mirrored: check the signs of its axes", mirrored),
        ("the picture is mirrored: check the order of the cloud's rows and columns", backwards),
    ):
        places = places_over(upright, target, near, options).candidates
        T, _ = refine(upright, target, places.poses[0], options)
        judged = judge(
            upright,
            target,
            T,
            inlier_m=float(mm_to_m(options.inlier_mm)),
            surface_bias_m=float(mm_to_m(options.surface_bias_mm)),
            rivals=places.rivals(options.rival_ratio),
            shape=(upright.points.shape[0] * upright.block, upright.points.shape[1] * upright.block),
        )
        if not options.gates.failures(judged.evidence):
            return fault
    return None

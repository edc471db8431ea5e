"""Gaps in traced vessels, where a glint, a crossing or noise broke the line: bridged by minimal paths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from brainshift_ros.vessels.minimal_path import trace_between
from brainshift_ros.vessels.skeleton import free_ends

_BEHIND_PX = 8  # pixels of the vessel that show where its end points to
_CONE_COSINE = 0.5
_WINDOW_MARGIN_PX = 8


def bridge_gaps(
    skeleton: NDArray[np.bool_],
    strength: NDArray[np.float32],
    glint: NDArray[np.bool_],
    longest_px: float,
    least_strength: float,
) -> NDArray[np.bool_]:
    """Lead free ends on to the vessel ahead of them, where the picture shows a vessel between or a glint hides it.

    Parameters
    ----------
    skeleton
        Shape (H, W), one pixel wide.
    strength
        Shape (H, W), vesselness.
    glint
        Shape (H, W), pixels whose vesselness is a repair.
    longest_px
        Longest gap.
    least_strength
        Mean vesselness that a bridge needs outside glints.

    Returns
    -------
    bridges
        Shape (H, W), pixels to add to the skeleton.
    """
    bridges = np.zeros_like(skeleton)
    line = np.argwhere(skeleton)
    if len(line) == 0:
        return bridges
    tree = cKDTree(line)
    components, _ = ndimage.label(skeleton, structure=np.ones((3, 3)))
    for end in free_ends(skeleton):
        target = _ahead(end, line, tree, components, longest_px)
        if target is None:
            continue
        low = np.maximum(np.minimum(end, target) - _WINDOW_MARGIN_PX, 0).astype(int)
        high = (np.maximum(end, target) + _WINDOW_MARGIN_PX + 1).astype(int)
        window = strength[low[0] : high[0], low[1] : high[1]]
        start, goal = end.astype(int) - low, target.astype(int) - low
        path = trace_between(window, (int(start[0]), int(start[1])), (int(goal[0]), int(goal[1]))).astype(int) + low
        rows, columns = path[1:-1].T
        shown = strength[rows, columns][~glint[rows, columns]]
        if shown.size == 0 or shown.mean() > least_strength:
            bridges[rows, columns] = True
    return bridges & ~skeleton


def _ahead(
    end: NDArray[np.float64], line: NDArray[np.intp], tree: cKDTree, components: NDArray[np.int32], longest_px: float
) -> NDArray[np.float64] | None:
    """Nearest pixel of another piece of vessel in the direction in which the end points."""
    near = line[tree.query_ball_point(end, max(longest_px, _BEHIND_PX))]
    own = components[near[:, 0], near[:, 1]] == components[int(end[0]), int(end[1])]
    offset = near - end
    distance = np.linalg.norm(offset, axis=1)
    behind = offset[own & (distance <= _BEHIND_PX)].mean(axis=0)
    length = np.linalg.norm(behind)
    if length == 0.0 or own.all():
        return None
    cosine = -(offset @ behind) / np.maximum(distance * length, 1e-9)
    candidates = ~own & (cosine > _CONE_COSINE) & (distance <= longest_px)
    if not candidates.any():
        return None
    return np.asarray(near[candidates][distance[candidates].argmin()], dtype=np.float64)

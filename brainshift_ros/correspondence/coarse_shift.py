"""Coarse shift between two plane views: template matching whose neighbours vote together."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from brainshift_ros.correspondence.plane_view import PlaneView

_CELL_M = 0.5e-3
_TEMPLATE_M = 13e-3
_NODE_SPACING_M = 6e-3
_VOTE_RADIUS_M = 9e-3
_VOTE_BLUR_M = 1.2e-3
_LEAST_SEEN = 0.5


@dataclass(frozen=True)
class CoarseShift:
    """Shift in the plane at nodes.

    Attributes
    ----------
    nodes
        Shape (n, 2), (column, row) in cells of the views.
    shift
        Shape (n, 2), cells.
    score
        Shape (n,), correlation after the vote, -1 to 1.
    """

    nodes: NDArray[np.float64]
    shift: NDArray[np.float64]
    score: NDArray[np.float64]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shift at points (k, 2), cells, by a smoothing thin-plate spline through the nodes."""
        if len(self.nodes) < 6:
            return np.broadcast_to(np.median(self.shift, axis=0), points.shape).copy()
        scale = np.ptp(self.nodes, axis=0).max()
        spline = RBFInterpolator(self.nodes / scale, self.shift, smoothing=1e-3 * len(self.nodes), kernel="thin_plate_spline")
        return spline(points / scale)


def match_coarsely(first: PlaneView, later: PlaneView, region: NDArray[np.bool_], cell_m: float, reach_m: float) -> CoarseShift:
    """Match patches of the first view within `reach_m` in the later one.

    A patch with few vessels matches in many places; summed with its neighbours' correlations, one place stands out. Only
    then the patch's own best match near that place is taken.

    Parameters
    ----------
    first, later
        Views on one grid.
    region
        Cells of the first view that show cortex.
    cell_m
        Cell size of the views, metres.
    reach_m
        Longest shift in the plane, metres.
    """
    factor = cell_m / _CELL_M
    small_first = cv2.resize(first.texture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    small_later = cv2.resize(later.texture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    size = (small_first.shape[1], small_first.shape[0])
    usable = cv2.resize((region & first.seen).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    half, reach = round(0.5 * _TEMPLATE_M / _CELL_M), round(reach_m / _CELL_M)
    pad = half + reach
    padded_first = cv2.copyMakeBorder(small_first * (usable > 0.5), pad, pad, pad, pad, cv2.BORDER_CONSTANT)
    padded_later = cv2.copyMakeBorder(small_later, pad, pad, pad, pad, cv2.BORDER_CONSTANT)
    share = cv2.blur(usable, (2 * half + 1, 2 * half + 1), borderType=cv2.BORDER_CONSTANT)
    step = round(_NODE_SPACING_M / _CELL_M)
    rows, columns = np.mgrid[step // 2 : size[1] : step, step // 2 : size[0] : step].reshape(2, -1)
    good = share[rows, columns] > _LEAST_SEEN
    rows, columns = rows[good], columns[good]
    if len(rows) == 0:
        return CoarseShift(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    centers = [(int(r) + pad, int(c) + pad) for r, c in zip(rows, columns, strict=True)]
    maps = np.stack([_correlation(padded_first, padded_later, r, c, half, reach) for r, c in centers])

    nodes = np.stack([columns, rows], axis=-1).astype(np.float64)
    apart = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1) * _CELL_M
    votes = np.exp(-0.5 * (apart / _VOTE_RADIUS_M) ** 2)
    votes /= votes.sum(axis=1, keepdims=True)
    blurred = np.stack([cv2.GaussianBlur(m, (0, 0), _VOTE_BLUR_M / _CELL_M) for m in maps])
    together = np.tensordot(votes.astype(np.float32), blurred, axes=1)
    shift, score = np.zeros_like(nodes), np.zeros(len(nodes))
    v, u = np.indices(maps.shape[1:])
    for k, (own, shared) in enumerate(zip(maps, together, strict=True)):
        peak = np.unravel_index(np.argmax(shared), shared.shape)
        near = np.exp(-0.5 * ((v - peak[0]) ** 2 + (u - peak[1]) ** 2) * (_CELL_M / 2e-3) ** 2)
        best = np.unravel_index(np.argmax((own + 0.2) * near), own.shape)
        shift[k] = (best[1] - reach, best[0] - reach)
        score[k] = own[best]
    kept = _consistent(nodes, shift, score)
    return CoarseShift((nodes[kept] + 0.5) / factor - 0.5, shift[kept] / factor, score[kept])


def _correlation(first: NDArray, later: NDArray, row: int, column: int, half: int, reach: int) -> NDArray[np.float32]:
    template = first[row - half : row + half + 1, column - half : column + half + 1]
    pad = half + reach
    window = later[row - pad : row + pad + 1, column - pad : column + pad + 1]
    scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    return np.where(np.isfinite(scores) & (np.abs(scores) <= 1.001), scores, 0.0).astype(np.float32)


def _consistent(nodes: NDArray[np.float64], shift: NDArray[np.float64], score: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Nodes that correlate and agree with the median of their neighbours within 3 mm."""
    apart = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1) * _CELL_M
    kept = score > 0.25
    for _ in range(2):
        if kept.sum() < 4:
            return kept
        agreed = kept.copy()
        for k in np.flatnonzero(kept):
            order = np.argsort(np.where(kept, apart[k], np.inf))[1:8]
            order = order[kept[order]]
            agreed[k] = np.linalg.norm(shift[k] - np.median(shift[order], axis=0)) * _CELL_M < 3e-3
        kept = agreed
    return kept

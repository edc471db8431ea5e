"""Fine tracking in the first view's own frame: the later view is warped onto it, so that turned windows match too."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.features import as_bytes
from brainshift_ros.correspondence.outliers import LEAST_POINTS, consistent_points
from brainshift_ros.correspondence.plane_view import PlaneView
from brainshift_ros.correspondence.smooth_field import SmoothField, fit_field

_LEAST_CLEAR = 0.6  # share of a window that must be clear in both views
_TYPICAL_ERROR_M = 0.25e-3
_SMOOTHING = 0.002


@dataclass(frozen=True)
class FineLimits:
    """What a track must hold.

    Attributes
    ----------
    window
        Odd side of the matched window, cells.
    most_loop
        Largest distance between a point and where it returns to when tracked back, cells.
    least_correlation
        Of the matched windows.
    """

    window: int
    most_loop: float
    least_correlation: float


@dataclass(frozen=True)
class FineTracks:
    """Candidates that were found again.

    Attributes
    ----------
    start, end
        Shape (n, 2), (column, row) in cells.
    correlation
        Shape (n,), of the matched windows.
    shift_variance
        Shape (n,), variance of an in-plane component by the structure tensor, cells^2.
    loop
        Shape (n,), distance between a point and where it returns to when tracked back, cells.
    """

    start: NDArray[np.float64]
    end: NDArray[np.float64]
    correlation: NDArray[np.float64]
    shift_variance: NDArray[np.float64]
    loop: NDArray[np.float64]

    def subset(self, kept: NDArray[np.bool_]) -> FineTracks:
        """Return the tracks where `kept`, shape (n,), is true."""
        return FineTracks(**{name: values[kept] for name, values in vars(self).items()})


NO_TRACKS = FineTracks(*(np.zeros((0, 2)) for _ in range(2)), *(np.zeros(0) for _ in range(3)))


def track_twice(
    first: PlaneView,
    later: PlaneView,
    candidates: NDArray[np.float64],
    field: SmoothField,
    limits: FineLimits,
    cell_m: float,
) -> FineTracks:
    """Track in the frame of a coarse field, then in that of the field through what was found, which turns as the tissue.

    Parameters
    ----------
    first, later
        Views on one grid.
    candidates
        Shape (n, 2), (column, row) in cells.
    field
        Where they are roughly.
    limits
        What a track must hold.
    cell_m
        Cell size, metres.
    """
    tracks = track_finely(first, later, candidates, field, limits, levels=2)
    start, end = (np.column_stack([at * cell_m, np.zeros(len(at))]) for at in (tracks.start, tracks.end))
    kept = consistent_points(start, end - start, np.full(len(start), _TYPICAL_ERROR_M))
    if kept.sum() < LEAST_POINTS:
        return tracks
    refined = fit_field(tracks.start[kept], (tracks.end - tracks.start)[kept], cell_m, _SMOOTHING)
    return track_finely(first, later, candidates, refined, limits, levels=1)


def track_finely(
    first: PlaneView,
    later: PlaneView,
    candidates: NDArray[np.float64],
    field: SmoothField,
    limits: FineLimits,
    *,
    levels: int,
) -> FineTracks:
    """Pyramidal Lucas-Kanade (Bouguet 2001) from the first view to the later one warped by a field, and back.

    Parameters
    ----------
    first, later, candidates, field, limits
        As for :func:`track_twice`.
    levels
        Coarser levels of the pyramid.
    """
    shift = field.over(first.texture.shape)
    u, v = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in first.texture.shape[::-1]))
    map_u, map_v = u + shift[..., 0], v + shift[..., 1]
    texture = np.asarray(cv2.remap(later.texture, map_u, map_v, cv2.INTER_CUBIC), dtype=np.float32)
    clear = np.asarray(cv2.remap(later.clear.astype(np.float32), map_u, map_v, cv2.INTER_LINEAR), dtype=np.float32)
    a, b = as_bytes(first.texture), as_bytes(texture)
    start = candidates.astype(np.float32)
    end, found = _lucas_kanade(a, b, start, start, limits.window, levels)
    back, found_back = _lucas_kanade(b, a, end, end, limits.window, levels)
    loop = np.linalg.norm(back - start, axis=1).astype(np.float64)
    first_clear = first.clear.astype(np.float32)
    kept, correlation, variance = [], [], []
    for k in np.flatnonzero(found & found_back & (loop < limits.most_loop)):
        evidence = _window_evidence((first.texture, first_clear), (texture, clear), start[k], end[k], limits.window)
        if evidence is not None and evidence[0] > limits.least_correlation:
            kept.append(k)
            correlation.append(evidence[0])
            variance.append(evidence[1])
    index = np.array(kept, dtype=np.intp)
    moved = end[index].astype(np.float64)
    return FineTracks(candidates[index], moved + field(moved), np.array(correlation), np.array(variance), loop[index])


def _lucas_kanade(
    source: NDArray[np.uint8],
    target: NDArray[np.uint8],
    points: NDArray[np.float32],
    guess: NDArray[np.float32],
    window: int,
    levels: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    if len(points) == 0:
        return points, np.zeros(0, dtype=bool)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        points[:, None],
        guess[:, None].copy(),
        winSize=(window, window),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.005),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(moved, dtype=np.float32)[:, 0], np.asarray(found).ravel() > 0


def _window_evidence(
    first: tuple[NDArray[np.float32], NDArray[np.float32]],
    later: tuple[NDArray[np.float32], NDArray[np.float32]],
    start: NDArray[np.float32],
    end: NDArray[np.float32],
    window: int,
) -> tuple[float, float] | None:
    """Correlation of the matched windows (texture, clearness), and the variance of an in-plane component (cells^2).

    Cramer-Rao for a shift: covariance = s^2 G^-1, G the sum of squared gradients over the window, s^2 the variance of the
    difference. Its noise is correlated over about 2 x 2 cells, hence the factor.
    """
    patch = [
        cv2.getRectSubPix(image, (window, window), (float(at[0]), float(at[1])))
        for view, at in ((first, start), (later, end))
        for image in view
    ]
    valid = (patch[1] > 0.9) & (patch[3] > 0.9)
    if valid.mean() < _LEAST_CLEAR or not valid[window // 2, window // 2]:
        return None
    x, y = (values[valid] - values[valid].mean() for values in (patch[0], patch[2]))
    correlation = float((x @ y) / max(float(np.sqrt((x @ x) * (y @ y))), 1e-9))
    gy, gx = (gradient[valid] for gradient in np.gradient(0.5 * (patch[0] + patch[2])))
    tensor = np.array([[gx @ gx, gx @ gy], [gx @ gy, gy @ gy]]) + 1e-6 * np.eye(2)
    covariance = 4.0 * float(np.mean((x - y) ** 2)) * np.linalg.inv(tensor)
    return correlation, float(np.trace(covariance) / 2)

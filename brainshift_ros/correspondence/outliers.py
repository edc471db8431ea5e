"""Outliers among homologous points: tissue moves smoothly, so a point must agree with its neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Fewer points do not say which of them is wrong.
LEAST_POINTS = 6

_NEIGHBOURS = 10
_REACH_M = 12e-3  # neighbours farther away say less
_SLACK_M = 0.4e-3  # what an affine fit of the neighbours may miss of a real shift


def consistent_points(
    points: NDArray[np.float64], displacements: NDArray[np.float64], sigma: NDArray[np.float64], threshold: float = 3.0
) -> NDArray[np.bool_]:
    """Which displacements agree with a robust affine fit of their neighbours, worst removed first.

    Parameters
    ----------
    points, displacements
        Shape (n, 3), metres.
    sigma
        Shape (n,), metres.
    threshold
        Accepted residual in standard deviations, slack included.

    Returns
    -------
    kept
        Shape (n,).
    """
    kept = np.ones(len(points), dtype=bool)
    tolerance = np.hypot(np.sqrt(3) * sigma, _SLACK_M)
    while kept.sum() >= LEAST_POINTS:
        index = np.flatnonzero(kept)
        score = disagreement(points[index], displacements[index]) / tolerance[index]
        worst = score.argmax()
        if score[worst] <= threshold:
            return kept
        # Points that spoil each other's neighbourhoods are taken out one at a time.
        kept[index[worst]] = False
    return kept


def disagreement(points: NDArray[np.float64], displacements: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each displacement from what a robust affine fit of its neighbours predicts.

    Parameters
    ----------
    points, displacements
        Shape (n, 3), metres.

    Returns
    -------
    distance
        Shape (n,), metres; NaN where fewer than six points leave nothing to compare with.
    """
    if len(points) < LEAST_POINTS:
        return np.full(len(points), np.nan)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1, kind="stable")[:, : min(_NEIGHBOURS, len(points) - 1)]
    distance = np.take_along_axis(apart, near, axis=1)
    offset = (points[near] - points[:, None]) / _REACH_M
    design = np.concatenate([np.ones((*near.shape, 1)), offset], axis=-1)
    base = np.exp(-0.5 * (distance / _REACH_M) ** 2) + 1e-3
    # Gradients are damped: neighbours on one side only must not extrapolate a wild slope.
    ridge = np.diag([1e-6, 0.03, 0.03, 0.03]) * base.sum(axis=1)[:, None, None]
    # A turn of the whole cortex is no disagreement: it is taken out first, since the damping would keep some of it.
    displacements = displacements - _trend(points, displacements)
    moved = displacements[near]
    weight = base
    for _ in range(4):
        weighted = (design * weight[..., None]).swapaxes(1, 2)
        fit = np.linalg.solve(weighted @ design + ridge, weighted @ moved)
        residual = np.linalg.norm(moved - design @ fit, axis=-1)
        scale = np.maximum(1.5 * np.median(residual, axis=1, keepdims=True), 0.3e-3)
        weight = base / (1.0 + (residual / scale) ** 2)
    return np.asarray(np.linalg.norm(displacements - fit[:, 0], axis=1))


def _trend(points: NDArray[np.float64], displacements: NDArray[np.float64]) -> NDArray[np.float64]:
    """Robust affine fit of all displacements, shape (n, 3)."""
    centred = points - points.mean(axis=0)
    design = np.column_stack([np.ones(len(points)), centred / _REACH_M])
    weight = np.ones(len(points))
    for _ in range(6):
        weighted = design.T * weight
        # The damping only settles what a flat patch leaves open: the change with height.
        fit = np.linalg.solve(weighted @ design + np.diag([0.0, 1e-2, 1e-2, 1e-2]), weighted @ displacements)
        residual = np.linalg.norm(displacements - design @ fit, axis=1)
        weight = 1.0 / (1.0 + (residual / max(1.5 * float(np.median(residual)), 0.3e-3)) ** 2)
    return np.asarray(design @ fit)

"""Outliers among homologous points: tissue moves smoothly, so a point must agree with its neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
    while kept.sum() >= 6:
        index = np.flatnonzero(kept)
        score = _misfits(points[index], displacements[index], sigma[index])
        worst = score.argmax()
        if score[worst] <= threshold:
            return kept
        # Points that spoil each other's neighbourhoods are taken out one at a time.
        kept[index[worst]] = False
    return kept


def _misfits(
    points: NDArray[np.float64], displacements: NDArray[np.float64], sigma: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance of each displacement from what its neighbours predict, in standard deviations, shape (n,)."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1, kind="stable")[:, : min(_NEIGHBOURS, len(points) - 1)]
    distance = np.take_along_axis(apart, near, axis=1)
    offset = (points[near] - points[:, None]) / _REACH_M
    design = np.concatenate([np.ones((*near.shape, 1)), offset], axis=-1)
    base = np.exp(-0.5 * (distance / _REACH_M) ** 2) + 1e-3
    # Gradients are damped: neighbours on one side only must not extrapolate a wild slope.
    ridge = np.diag([1e-6, 0.03, 0.03, 0.03]) * base.sum(axis=1)[:, None, None]
    moved = displacements[near]
    weight = base
    for _ in range(4):
        weighted = design * weight[..., None]
        normal = np.einsum("nki,nkj->nij", design, weighted) + ridge
        fit = np.linalg.solve(normal, np.einsum("nki,nkd->nid", weighted, moved))
        residual = np.linalg.norm(moved - design @ fit, axis=-1)
        scale = np.maximum(1.5 * np.median(residual, axis=1, keepdims=True), 0.3e-3)
        weight = base / (1.0 + (residual / scale) ** 2)
    return np.linalg.norm(displacements - fit[:, 0], axis=1) / np.hypot(np.sqrt(3) * sigma, _SLACK_M)

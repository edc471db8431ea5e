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
        score = np.array([_misfit(int(k), index[index != k], points, displacements, sigma) for k in index])
        worst = score.argmax()
        if score[worst] <= threshold:
            return kept
        # Points that spoil each other's neighbourhoods are taken out one at a time.
        kept[index[worst]] = False
    return kept


def _misfit(
    k: int,
    others: NDArray[np.intp],
    points: NDArray[np.float64],
    displacements: NDArray[np.float64],
    sigma: NDArray[np.float64],
) -> float:
    distance = np.linalg.norm(points[others] - points[k], axis=1)
    order = np.argsort(distance, kind="stable")[:_NEIGHBOURS]
    near, distance = others[order], distance[order]
    design = np.concatenate([np.ones((len(near), 1)), (points[near] - points[k]) / _REACH_M], axis=1)
    base = np.exp(-0.5 * (distance / _REACH_M) ** 2) + 1e-3
    weight = base
    ridge = np.diag([1e-6, 0.3, 0.3, 0.3]) * base.sum() * 0.1
    for _ in range(4):
        weighted = design * weight[:, None]
        fit = np.linalg.solve(design.T @ weighted + ridge, weighted.T @ displacements[near])
        residual = np.linalg.norm(displacements[near] - design @ fit, axis=1)
        scale = max(1.5 * float(np.median(residual)), 0.3e-3)
        weight = base / (1.0 + (residual / scale) ** 2)
    error = float(np.linalg.norm(displacements[k] - fit[0]))
    return error / float(np.hypot(np.sqrt(3) * sigma[k], _SLACK_M))

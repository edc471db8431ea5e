"""Coarse match of two views: features that look alike, kept where neighbours agree about turn and stretch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from brainshift_ros.correspondence.features import Features
from brainshift_ros.correspondence.smooth_field import SmoothField

_RATIO = 0.9  # of the best to the second best distance of descriptors (Lowe 2004)
_NEAR_M, _FAR_M = 1.5e-3, 15e-3  # neighbours whose distance says something about stretch and turn
_STRETCH = 1.3
_SLACK_M = 0.6e-3
_TURN = np.deg2rad(25.0)  # between a feature's own turn and the turn of the chord to a neighbour
_MEAN_TURN = np.deg2rad(15.0)  # the same with the mean turn around a feature
_LEAST_AGREEING, _LEAST_TIES, _LEAST_SHARE = 4, 3, 0.4


@dataclass(frozen=True)
class Matches:
    """Places in the first view and where they are in the later one.

    Attributes
    ----------
    first, later
        Shape (n, 2), (column, row) in cells.
    proposed
        How many looked alike before neighbours were asked.
    """

    first: NDArray[np.float64]
    later: NDArray[np.float64]
    proposed: int


def match_features(
    first: Features,
    later: Features,
    cell_m: float,
    *,
    reach_m: float,
    turn_rad: float,
    near: SmoothField | None = None,
) -> Matches:
    """Match features by their descriptors, then keep the largest set in which neighbours agree.

    Parameters
    ----------
    first, later
        Features of the two views, which lie on one grid.
    cell_m
        Cell size, metres.
    reach_m, turn_rad
        Longest shift and largest turn, relative to `near` if that is given.
    near
        Shift that is known roughly already; none: zero.
    """
    nothing = Matches(np.zeros((0, 2)), np.zeros((0, 2)), 0)
    if len(first.at) < 2 or len(later.at) < 2:
        return nothing
    expected, expected_turn = first.at, first.turn
    if near is not None:
        expected = first.at + near(first.at)
        tip = first.at + np.stack([np.cos(first.turn), np.sin(first.turn)], axis=-1) * (1e-3 / cell_m)
        moved = tip + near(tip) - expected
        expected_turn = np.arctan2(moved[:, 1], moved[:, 0])
    possible = _squared_distances(expected * cell_m, later.at * cell_m) < reach_m**2
    possible &= _cosines(expected_turn, later.turn) > np.cos(turn_rad)
    distance = np.where(possible, np.sqrt(_squared_distances(first.descriptor, later.descriptor)), np.float32(np.inf))
    best = distance.argmin(axis=1)
    rows = np.arange(len(first.at))
    closest = distance[rows, best]
    mutual = np.flatnonzero(np.isfinite(closest) & (distance.argmin(axis=0)[best] == rows))
    # One place may carry several orientations: the second best must be another place.
    elsewhere = _squared_distances(later.at[best[mutual]] * cell_m, later.at * cell_m) > _SLACK_M**2
    second = np.where(elsewhere, distance[mutual], np.inf).min(axis=1)
    chosen = mutual[closest[mutual] < _RATIO * second]
    if len(chosen) == 0:
        return nothing
    a, b = first.at[chosen], later.at[best[chosen]]
    turn = _wrapped(later.turn[best[chosen]] - first.turn[chosen])
    kept = agreeing(a * cell_m, b * cell_m, turn, connected=near is None)
    return Matches(a[kept], b[kept], len(chosen))


def agreeing(
    first_m: NDArray[np.float64], later_m: NDArray[np.float64], turn: NDArray[np.float64], *, connected: bool
) -> NDArray[np.bool_]:
    """Tell which matches agree with their neighbours.

    Two matches agree when the chord between them is stretched by less than 1.3 and turned as both features are. A match
    stays when enough of its neighbours, and at least four, agree with it.

    Parameters
    ----------
    first_m, later_m
        Shape (n, 2), metres.
    turn
        Shape (n,), radians.
    connected
        Keep only the largest set that agreement connects: another cluster, however coherent in itself, is not connected to
        it. Not asked where the shift is known roughly, since an instrument may lie between right clusters.
    """
    a, b = (points[:, 0] + 1j * points[:, 1] for points in (first_m, later_m))
    chord_a, chord_b = a[None] - a[:, None], b[None] - b[:, None]
    length_a, length_b = np.abs(chord_a), np.abs(chord_b)
    neighbour = (length_a > _NEAR_M) & (length_a < _FAR_M)
    stretched = (length_b < length_a * _STRETCH + _SLACK_M) & (length_b > length_a / _STRETCH - _SLACK_M)
    chord_turn = np.angle(chord_b * np.conj(chord_a))
    slack = _SLACK_M / np.maximum(length_a, _NEAR_M)

    def agreement(turn: NDArray[np.float64], limit: float) -> NDArray[np.bool_]:
        alike = np.abs(_wrapped(chord_turn - turn[:, None])) < limit + slack
        return np.asarray(neighbour & stretched & alike & alike.T)

    agrees = agreement(turn, _TURN)
    kept = np.ones(len(a), dtype=bool)
    for _ in range(20):
        support = (agrees & kept[None]).sum(axis=1)
        asked = (neighbour & kept[None]).sum(axis=1)
        now = kept & (support >= _LEAST_AGREEING) & (support >= _LEAST_SHARE * asked)
        if (now == kept).all():
            break
        kept = now
    if not kept.any() or not connected:
        return kept
    # One feature's turn is noisy, the mean of those that agree with it is not; and one chance agreement must not tie two
    # clusters together: most common neighbours must agree with both ends.
    mean_turn = np.angle(((agrees | np.eye(len(a), dtype=bool)) & kept[None]) @ np.exp(1j * turn))
    index = np.flatnonzero(kept)
    both = (agreement(mean_turn, _MEAN_TURN), neighbour)
    agreed, near = (pairs[np.ix_(index, index)].astype(np.float32) for pairs in both)
    shared = agreed @ agreed
    tied = (agreed > 0) & (shared >= _LEAST_TIES) & (shared >= _LEAST_SHARE * (near @ near))
    _, label = connected_components(tied, directed=False)
    kept[index] = label == np.bincount(label).argmax()
    return kept


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _squared_distances(first: NDArray[np.floating], later: NDArray[np.floating]) -> NDArray[np.float32]:
    """Squared distances of all pairs of rows, shape (n, m), by one product of matrices."""
    a, b = (rows.astype(np.float32) for rows in (first, later))
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2.0 * a @ b.T
    return np.asarray(np.maximum(squared, 0.0), dtype=np.float32)


def _cosines(first: NDArray[np.float64], later: NDArray[np.float64]) -> NDArray[np.float32]:
    """Cosines of the differences of all pairs of angles, shape (n, m)."""
    a, b = (np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32) for angle in (first, later))
    return np.asarray(a @ b.T)

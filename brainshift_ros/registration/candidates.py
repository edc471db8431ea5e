"""From many starts to the few places where a scan fits: coarse to fine, with fewer starts and more points at each stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import transform_points
from brainshift_ros.registration.icp import coarse_icp, fit_scores
from brainshift_ros.registration.patch import OrientedPoints
from brainshift_ros.registration.target import CortexTarget
from brainshift_ros.units import mm_to_m


@dataclass(frozen=True)
class Stage:
    """One stage of the narrowing.

    Attributes
    ----------
    points
        How many points of the scan take part.
    distance_mm
        Largest correspondence distance.
    iterations
        Steps of every start.
    kept
        How many of the best starts go on.
    """

    points: int
    distance_mm: float
    iterations: int
    kept: int


@dataclass(frozen=True)
class Candidates:
    """Distinct places, best first: poses (k, 4, 4) and scores (k,), 0 to 1."""

    poses: NDArray[np.float64]
    scores: NDArray[np.float64]

    def rivals(self, ratio: float) -> int:
        """How many places other than the best score at least `ratio` times as much."""
        return int((self.scores[1:] >= ratio * self.scores[0]).sum())


def narrow(
    cloud: OrientedPoints,
    target: CortexTarget,
    starts: NDArray[np.float64],
    stages: tuple[Stage, ...],
    *,
    score_mm: float,
    distinct_mm: float,
) -> Candidates:
    """Align all starts a little, keep the better ones, and go on with more points (successive halving).

    Parameters
    ----------
    cloud
        The scan, tracker frame.
    target
        The cortex.
    starts
        Shape (s, 4, 4), T_patient_tracker.
    stages
        Coarse to fine.
    score_mm
        Distance at which a point counts for nothing in the last stage's score; earlier ones are as much more lenient as
        their correspondence distance is longer.
    distinct_mm
        Poses that move the scan's points by less than this on average against each other are one place.
    """
    poses = starts
    scores = np.zeros(len(poses))
    last_mm = stages[-1].distance_mm
    extent = cloud.thinned(12).points
    for stage in stages:
        part = cloud.thinned(stage.points)
        poses = coarse_icp(part, target, poses, float(mm_to_m(stage.distance_mm)), stage.iterations)
        scores = fit_scores(part, target, poses, float(mm_to_m(score_mm * np.sqrt(stage.distance_mm / last_mm))))
        order = np.argsort(-scores, kind="stable")
        order = order[_distinct(poses[order], extent, float(mm_to_m(distinct_mm)), stage.kept)]
        poses, scores = poses[order], scores[order]
    return Candidates(poses, scores)


def _distinct(poses: NDArray[np.float64], points: NDArray[np.float64], apart_m: float, most: int) -> list[int]:
    """Greedily pick poses (s, 4, 4), best first, that lay the points (n, 3) elsewhere than those picked before."""
    picked: list[int] = []
    laid = np.empty((0, *points.shape))
    for number, pose in enumerate(poses):
        moved = transform_points(pose, points)
        if len(picked) == 0 or np.linalg.norm(laid - moved, axis=2).mean(axis=1).min() > apart_m:
            picked.append(number)
            laid = np.concatenate([laid, moved[None]])
            if len(picked) == most:
                break
    return picked

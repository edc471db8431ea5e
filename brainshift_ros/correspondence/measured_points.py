"""From tracks in the plane to homologous points in tracker space: lifted, checked against neighbours, with a sigma each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from brainshift_ros.correspondence.fine_tracking import FineTracks
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.correspondence.lifting import lift
from brainshift_ros.correspondence.outliers import consistent_points, disagreement
from brainshift_ros.correspondence.plane_view import PlaneGrid, PlaneView
from brainshift_ros.correspondence.point_sigma import PointEvidence, point_sigma
from brainshift_ros.geometry import invert_rigid, transform_points


@dataclass(frozen=True)
class MeasuredPoints:
    """Homologous points and the tracks that they come from.

    Attributes
    ----------
    points
        Tracker frame.
    tracks
        Of the same length.
    outliers
        How many were dropped since they disagree with their neighbours.
    """

    points: HomologousPoints
    tracks: FineTracks
    outliers: int


def measure_points(
    first: PlaneView, later: PlaneView, grid: PlaneGrid, tracks: FineTracks, *, tracker_m: float
) -> MeasuredPoints:
    """Lift tracks to 3-D; drop those that were not seen well enough or disagree with their neighbours.

    Parameters
    ----------
    first, later
        Views on `grid`.
    grid
        The plane.
    tracks
        Between the views.
    tracker_m
        Root mean square error of the tracked scanner's position in one scan, metres.
    """
    cell = grid.cell_m
    start, start_noise = lift(first.height, tracks.start, cell)
    end, end_noise = lift(later.height, tracks.end, cell)
    seen = np.isfinite(np.concatenate([start, end], axis=1)).all(axis=1)
    tracks, start, shift = tracks.subset(seen), start[seen], (end - start)[seen]
    shift_variance, lift_variance = tracks.shift_variance * cell**2, (start_noise**2 + end_noise**2)[seen]

    alone = PointEvidence(shift_variance, lift_variance, np.zeros(len(start)))
    kept = consistent_points(start, shift, point_sigma(alone, 0.0))
    start, shift = start[kept], shift[kept]
    evidence = PointEvidence(shift_variance[kept], lift_variance[kept], disagreement(start, shift))
    T_tracker_plane = invert_rigid(grid.T_plane_tracker)
    points = HomologousPoints(
        points=transform_points(T_tracker_plane, start),
        displacements=shift @ T_tracker_plane[:3, :3].T,
        sigma=point_sigma(evidence, tracker_m),
    )
    return MeasuredPoints(points, tracks.subset(kept), int((~kept).sum()))

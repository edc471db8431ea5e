"""Coarse field from the first to the later view: over the whole reach automatically, or from a person's guides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.coarse_match import match_features
from brainshift_ros.correspondence.features import Features
from brainshift_ros.correspondence.smooth_field import SmoothField, field_through

_GUIDED_REACH_M = 10e-3  # how far tissue moves beside a similarity through a few guides
_NEAR_REACH_M = 4e-3  # once a coarse field is known
_NEAR_TURN_RAD = np.deg2rad(25.0)

Pairs = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class CoarseField:
    """What the coarse match found.

    Attributes
    ----------
    field
        Shift in the plane; None where nothing is believed.
    matches
        Features that match and agree.
    proposed
        Features that looked alike before their neighbours were asked.
    """

    field: SmoothField | None
    matches: int
    proposed: int


def coarse_field(
    first: Features,
    later: Features,
    cell_m: float,
    *,
    reach_m: float,
    turn_rad: float,
    least_matches: int,
    guides: Pairs | None = None,
) -> CoarseField:
    """Match features over the whole reach, or near where guides say; then again, near where those matches say.

    Parameters
    ----------
    first, later
        Features of the two views on one grid.
    cell_m
        Cell size, metres.
    reach_m, turn_rad
        Longest shift and largest turn without guides.
    least_matches
        So many must agree, else the match is not believed.
    guides
        Places in the first and the later view, (column, row) in cells, shape (n, 2) each; they are believed.
    """
    if guides is None:
        known = None
        matches = match_features(first, later, cell_m, reach_m=reach_m, turn_rad=turn_rad)
    else:
        known = field_through(*guides, cell_m)
        matches = match_features(first, later, cell_m, reach_m=_GUIDED_REACH_M, turn_rad=_NEAR_TURN_RAD, near=known)
    if len(matches.first) < least_matches:
        return CoarseField(known, len(matches.first), matches.proposed)
    near = field_through(matches.first, matches.later, cell_m)
    again = match_features(first, later, cell_m, reach_m=_NEAR_REACH_M, turn_rad=_NEAR_TURN_RAD, near=near)
    if len(again.first) <= len(matches.first):
        return CoarseField(near, len(matches.first), matches.proposed)
    return CoarseField(field_through(again.first, again.later, cell_m), len(again.first), again.proposed)

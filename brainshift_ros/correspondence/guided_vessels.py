"""Vessels that a person marks by their two ends in both scans, matched along their length (thesis fig. 55)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from brainshift_ros.correspondence.guides import Guides
from brainshift_ros.correspondence.unrolled import Stretch, best_match, unroll
from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.units import m_to_mm
from brainshift_ros.vessels.minimal_path import trace_between
from brainshift_ros.vessels.tracing import enhance_vessels

_SNAP_M = 1.0e-3  # how far beside a vessel a person may click
_SNAP_SIGMA_M = 0.5e-3  # keeps the end from sliding along the vessel to its strongest spot
_SHORTEST_M = 4.0e-3
_PAIR_SPACING_M = 3.0e-3
_LEAST_STRENGTH = 0.012
_LEAST_SEEN = 0.2
_SMOOTH_M = 1.5e-3  # of the range's noise along a path
_DETOUR_M = 10e-3

#: Costs of leaving the vessel: low ones cross gaps, high ones follow loops. The two scans decide together which is right.
_OFF_VESSEL = (0.02, 0.08, 0.3)


@dataclass(frozen=True)
class VesselEnds:
    """The same stretch of vessel in two scans.

    Attributes
    ----------
    first_px, later_px
        Shape (2, 2): (row, column) of its start and its end in the textures of the first and the later scan.
    """

    first_px: NDArray[np.float64]
    later_px: NDArray[np.float64]


def vessel_pairs(first: OrganisedScan, later: OrganisedScan, ends: Sequence[VesselEnds]) -> Guides:
    """Match marked vessels point by point.

    In each scan minimal paths join the ends. The two paths, one of each scan, whose unrolled strips of texture agree best
    are taken. They are measured in 3-D, and points at the same share of the length belong together; what the person's ends
    missed along the vessel is made good by sliding one strip along the other, where side branches and bends show.

    Parameters
    ----------
    first, later
        Organised scans; the frame does not matter.
    ends
        At least one vessel, 4 mm or longer; ends within 1 mm of it.

    Returns
    -------
    Guides
        A pair about every 3 mm, three or more for each vessel.

    Raises
    ------
    InputError
        No vessel is given; or one, which the message names, has an end outside the picture, is too short, is not there
        between its ends, or lies where the scan saw no range.
    """
    if len(ends) == 0:
        raise InputError("vessels", "none is given", "mark at least one vessel by its two ends in both scans")
    one, two = _Picture(first, "first scan"), _Picture(later, "later scan")
    pairs = []
    for number, vessel in enumerate(ends, start=1):
        match = best_match(one.trace(vessel.first_px, number), two.trace(vessel.later_px, number))
        pairs.append(match.pairs(_PAIR_SPACING_M))
    return Guides(np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs]))


class _Picture:
    """A scan in which vessels are traced between given ends."""

    def __init__(self, scan: OrganisedScan, name: str) -> None:
        self._scan, self._name = scan, name
        self._image = enhance_vessels(scan)

    def trace(self, ends_px: NDArray[np.float64], number: int) -> list[Stretch]:
        """Stretches of vessel between two ends, cheapest paths under different costs; at least one."""
        source = f"vessel {number}, {self._name}"
        ends = np.asarray(ends_px, dtype=np.float64)
        if ends.shape != (2, 2) or not np.isfinite(ends).all():
            raise InputError(source, f"ends of shape {ends.shape} or not finite", "give (row, column) of its start and its end")
        start, end = (self._snap(at, f"{source}, {which}") for at, which in zip(ends, ("start", "end"), strict=True))
        stretches: list[Stretch] = []
        lengths: set[int] = set()
        for path in self._paths(start, end):
            self._check_vessel(path, source)
            if len(path) in lengths:  # another cost, the same path
                continue
            lengths.add(len(path))
            stretches.append(unroll(self._image.flat, path, self._arc_length(path, source), self._image.pixel_m))
        length_m = min(stretch.length_m for stretch in stretches)
        if length_m < _SHORTEST_M:
            problem = f"its ends are {m_to_mm(length_m):.1f} mm apart"
            raise InputError(source, problem, f"mark a stretch of {m_to_mm(_SHORTEST_M):.0f} mm or more")
        return stretches

    def _snap(self, at: NDArray[np.float64], source: str) -> tuple[int, int]:
        """Strongest vessel nearby; nearer ones count more."""
        strength, pixel_m = self._image.strength, self._image.pixel_m
        rows, columns = strength.shape
        if not (-0.5 <= at[0] <= rows - 0.5 and -0.5 <= at[1] <= columns - 0.5):
            problem = f"(row {at[0]:g}, column {at[1]:g}) lies outside the picture of {rows} x {columns} pixels"
            raise InputError(source, problem, "give (row, column), the row first")
        v, u = np.indices(strength.shape)
        distance_m = np.hypot(v - at[0], u - at[1]) * pixel_m
        score = np.where(distance_m <= _SNAP_M, strength * np.exp(-0.5 * (distance_m / _SNAP_SIGMA_M) ** 2), -1.0)
        row, column = np.unravel_index(score.argmax(), score.shape)
        if score[row, column] <= 0.0:  # flat picture: nothing to snap to
            row, column = np.clip(np.round(at), 0, np.array(strength.shape) - 1).astype(int)
        return int(row), int(column)

    def _paths(self, start: tuple[int, int], end: tuple[int, int]) -> list[NDArray[np.float64]]:
        """Minimal paths within a box that leaves room for a winding vessel."""
        chord = float(np.hypot(start[0] - end[0], start[1] - end[1]))
        margin = max(_DETOUR_M / self._image.pixel_m, 0.5 * chord)
        low = np.maximum(np.minimum(start, end) - margin, 0).astype(int)
        high = np.minimum(np.maximum(start, end) + margin + 1, self._image.strength.shape).astype(int)
        window = self._image.strength[low[0] : high[0], low[1] : high[1]]
        a, b = (start[0] - low[0], start[1] - low[1]), (end[0] - low[0], end[1] - low[1])
        return [trace_between(window, a, b, off_vessel=off) + low for off in _OFF_VESSEL]

    def _check_vessel(self, path: NDArray[np.float64], source: str) -> None:
        rows, columns = path.astype(np.intp).T
        shown = self._image.strength[rows, columns][~self._image.glint[rows, columns]]
        if shown.size and np.median(shown) < _LEAST_STRENGTH:
            raise InputError(
                source, "no vessel is to be seen between its ends", "mark both ends on one vessel, within 1 mm of it"
            )

    def _arc_length(self, path: NDArray[np.float64], source: str) -> NDArray[np.float64]:
        """Length in metres up to each pixel; a smoothing spline takes out the noise of the range and fills its gaps."""
        rows, columns = path.astype(np.intp).T
        points = self._scan.points[rows, columns].astype(np.float64)
        steps = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
        seen = np.isfinite(points).all(axis=1)
        if seen.sum() < max(5, _LEAST_SEEN * len(path)):
            raise InputError(source, f"the scan saw {seen.sum()} of its {len(path)} points", "mark a vessel that it saw")
        stiffness = (_SMOOTH_M / self._image.pixel_m) ** 4  # a smoothing spline averages over its fourth root
        smooth = make_smoothing_spline(steps[seen], points[seen], lam=stiffness)(steps)
        return np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))]

"""Homologous points: vessel features of the first scan found again in a later scan, with a standard deviation each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.candidates import choose_candidates, spaced
from brainshift_ros.correspondence.coarse_field import CoarseField, Pairs, coarse_field
from brainshift_ros.correspondence.coverage import FAR_M, far_share
from brainshift_ros.correspondence.features import Features, find_features
from brainshift_ros.correspondence.fine_tracking import NO_TRACKS, FineLimits, track_twice
from brainshift_ros.correspondence.guides import LEAST_PAIRS, Guides, cells_of_pixels
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.correspondence.measured_points import measure_points
from brainshift_ros.correspondence.obstacles import find_obstacles
from brainshift_ros.correspondence.plane_view import PlaneGrid, PlaneView, covered_cells, grid_over, matchable, resample
from brainshift_ros.errors import InputError
from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.timing import timed
from brainshift_ros.units import m_to_mm, mm_to_m

_CLOSING_M = 2.5e-3  # dropouts in the mask of the cortex
_FEW_POINTS = 20
_FAR_SHARE = 0.15


@dataclass(frozen=True)
class TrackingOptions:
    """Settings of the correspondence.

    Attributes
    ----------
    cell_mm
        Cells of the plane views; a coarser scan gets cells of its own spacing.
    reach_mm, turn_deg
        Longest shift in the plane of the craniotomy, and largest turn, that are found without guides.
    spacing_mm
        Least distance between homologous points.
    most_points
        Candidates, strongest first.
    window_mm
        Side of the window that is matched.
    forward_backward_mm
        Largest distance between a point and where it returns to when tracked back.
    least_correlation
        Correlation of the matched windows.
    least_matches
        Features that must agree before a coarse match is believed.
    tracker_mm
        Root mean square error of the tracked scanner's position in a scan, from the tracker's data sheet; it goes into sigma.
    """

    cell_mm: float = 0.2
    reach_mm: float = 35.0
    turn_deg: float = 45.0
    spacing_mm: float = 3.5
    most_points: int = 90
    window_mm: float = 4.4
    forward_backward_mm: float = 0.4
    least_correlation: float = 0.6
    least_matches: int = 10
    tracker_mm: float = 0.22


@dataclass(frozen=True)
class FirstView:
    """The first scan, prepared for any number of later ones (tracker frame).

    Attributes
    ----------
    scan
        The scan itself.
    grid, view
        The plane over its cortex, and the scan on it.
    region
        Cells that show cortex.
    candidates
        Shape (n, 2), (column, row) in cells: where homologous points are looked for.
    features
        What the coarse match recognises.
    cortex_redness
        Colour of the cortex in it, as :func:`~brainshift_ros.correspondence.obstacles.find_obstacles` needs it.
    """

    scan: OrganisedScan
    grid: PlaneGrid
    view: PlaneView
    region: NDArray[np.bool_]
    candidates: NDArray[np.float64]
    features: Features
    cortex_redness: float


@dataclass(frozen=True)
class Tracking:
    """Homologous points in *tracker* space and how they were found.

    Attributes
    ----------
    points
        Points, displacements and standard deviations, tracker frame.
    correlation, forward_backward_m
        Shape (n,), local evidence of each.
    diagnostics
        ``candidates``, ``tracked``, ``outliers``, ``coarse_matches``, ``far_share``, ...
    warnings
        What a person should know.
    times_s
        Seconds by stage.
    """

    points: HomologousPoints
    correlation: NDArray[np.float64]
    forward_backward_m: NDArray[np.float64]
    diagnostics: Mapping[str, float]
    warnings: tuple[str, ...]
    times_s: Mapping[str, float]


def prepare_first(scan: OrganisedScan, cortex_mask: NDArray[np.bool_], options: TrackingOptions | None = None) -> FirstView:
    """Resample the first scan over its cortex and choose candidate points on vessels.

    Parameters
    ----------
    scan
        First scan, tracker frame.
    cortex_mask
        Shape (H, W): its pixels on the cortex, from the registration.
    options
        Settings.

    Raises
    ------
    InputError
        When no vessel structure is found on the cortex.
    """
    options = options or TrackingOptions()
    cell = max(float(mm_to_m(options.cell_mm)), pixel_spacing(scan))
    grid = grid_over(scan, cortex_mask & scan.seen, cell, margin_m=float(mm_to_m(options.reach_mm)))
    inside = covered_cells(scan, grid, cortex_mask)
    size = 2 * max(1, round(_CLOSING_M / cell)) + 1
    region = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)) > 0
    image = resample(scan, grid)
    obstacles = find_obstacles(image, region, cell)
    view = matchable(image, obstacles.cells, cell)
    candidates = choose_candidates(
        view,
        region,
        cell,
        window_m=float(mm_to_m(options.window_mm)),
        spacing_m=float(mm_to_m(options.spacing_mm)),
        most=options.most_points,
    )
    if len(candidates) < 6:
        raise InputError("first scan", f"{len(candidates)} vessel features on the cortex", "send a sharp, textured scan")
    features = find_features(view, region & view.clear, cell)
    return FirstView(scan, grid, view, region & ~obstacles.cells, candidates, features, obstacles.cortex_redness)


def track(
    first: FirstView, later_scan: OrganisedScan, options: TrackingOptions | None = None, guides: Guides | None = None
) -> Tracking:
    """Find the first scan's vessel features in a later scan.

    Parameters
    ----------
    first
        From :func:`prepare_first`.
    later_scan
        Same tracker frame; the scanner may have moved.
    options
        Settings.
    guides
        A person's pairs; they replace the automatic coarse match and are candidates themselves.

    Raises
    ------
    InputError
        When fewer than three guides lie where both scans saw something.
    """
    options = options or TrackingOptions()
    cell = first.grid.cell_m
    times: dict[str, float] = {}
    with timed(times, "resample"):
        image = resample(later_scan, first.grid)
        obstacles = find_obstacles(image, first.region, cell, first.cortex_redness)
        later = matchable(image, obstacles.cells, cell)
    with timed(times, "coarse"):
        guide_cells = None if guides is None else _guide_cells(first, later_scan, guides)
        coarse = coarse_field(
            first.features,
            find_features(later, later.clear, cell),
            cell,
            reach_m=float(mm_to_m(options.reach_mm)),
            turn_rad=float(np.deg2rad(options.turn_deg)),
            least_matches=options.least_matches,
            guides=guide_cells,
        )
    with timed(times, "fine"):
        candidates = first.candidates
        if guide_cells is not None:
            spacing = float(mm_to_m(options.spacing_mm)) / cell
            candidates = spaced(np.concatenate([guide_cells[0], candidates]), first.region.shape, spacing)
        limits = FineLimits(
            window=2 * round(0.5 * float(mm_to_m(options.window_mm)) / cell) + 1,
            most_loop=float(mm_to_m(options.forward_backward_mm)) / cell,
            least_correlation=options.least_correlation,
        )
        tracks = NO_TRACKS if coarse.field is None else track_twice(first.view, later, candidates, coarse.field, limits, cell)
    with timed(times, "lift"):
        found = measure_points(first.view, later, first.grid, tracks, tracker_m=float(mm_to_m(options.tracker_mm)))
    kept = found.tracks
    far = far_share(first.region, kept.start, cell)
    return Tracking(
        points=found.points,
        correlation=kept.correlation,
        forward_backward_m=kept.loop * cell,
        diagnostics={
            "candidates": float(len(candidates)),
            "tracked": float(len(tracks.start)),
            "outliers": float(found.outliers),
            "coarse_matches": float(coarse.matches),
            "coarse_proposed": float(coarse.proposed),
            "far_share": far,
        },
        warnings=_warnings(len(found.points.points), far, coarse),
        times_s=times,
    )


def _guide_cells(first: FirstView, later_scan: OrganisedScan, guides: Guides) -> Pairs:
    """Guides as cells of the first and the later view, those that both scans saw."""
    cells = [
        cells_of_pixels(scan, first.grid, pixels)
        for scan, pixels in ((first.scan, guides.first_px), (later_scan, guides.later_px))
    ]
    seen = np.isfinite(np.concatenate(cells, axis=1)).all(axis=1)
    if seen.sum() < LEAST_PAIRS:
        raise InputError(
            "guides",
            f"only {seen.sum()} of {len(guides.first_px)} pairs lie where both scans saw something",
            "click beside the dropout",
        )
    return cells[0][seen], cells[1][seen]


def _warnings(points: int, far: float, coarse: CoarseField) -> tuple[str, ...]:
    warnings = []
    if coarse.field is None:
        warnings.append(
            f"the later scan was not recognised: {coarse.matches} of {coarse.proposed} matched features agree; "
            "is it the same cortex? A person's guides can say where it went"
        )
    if points < _FEW_POINTS:
        warnings.append(f"only {points} homologous points")
    if points and far > _FAR_SHARE:
        warnings.append(
            f"{far:.0%} of the first scan's cortex lie farther than {m_to_mm(FAR_M):.0f} mm from any homologous point"
        )
    return tuple(warnings)

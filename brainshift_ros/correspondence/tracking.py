"""Homologous points: vessel features of the first scan found again in a later scan, with a standard deviation each."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.coarse_shift import CoarseShift, match_coarsely
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.correspondence.lifting import lift
from brainshift_ros.correspondence.outliers import consistent_points
from brainshift_ros.correspondence.plane_view import PlaneGrid, PlaneView, covered_cells, grid_over, view_scan
from brainshift_ros.correspondence.vesselness import vesselness
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.units import mm_to_m

_SPREAD_M = 6e-3
_RIM_M = 0.8e-3


@dataclass(frozen=True)
class TrackingOptions:
    """Settings of the correspondence.

    Attributes
    ----------
    reach_mm
        Longest shift in the plane of the craniotomy.
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
    sigma_floor_cells
        Least standard deviation, in cells of the plane view: what windows that only shift cannot follow. From simulation.
    """

    reach_mm: float = 20.0
    spacing_mm: float = 3.5
    most_points: int = 90
    window_mm: float = 4.4
    forward_backward_mm: float = 0.4
    least_correlation: float = 0.6
    sigma_floor_cells: float = 0.2


@dataclass(frozen=True)
class FirstView:
    """The first scan, prepared for any number of later ones (tracker frame)."""

    grid: PlaneGrid
    view: PlaneView
    region: NDArray[np.bool_]
    candidates: NDArray[np.float64]


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
        ``candidates``, ``tracked``, ``outliers``, ``coarse_nodes``, ...
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
    cell = max(0.2e-3, pixel_spacing(scan))
    grid = grid_over(scan.points[cortex_mask & scan.seen].astype(np.float64), cell, margin_m=float(mm_to_m(options.reach_mm)))
    view = view_scan(scan, grid)
    inside = covered_cells(scan, grid, cortex_mask)
    size = 2 * max(1, round(1e-3 / cell)) + 1
    region = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)) > 0
    candidates = _choose_candidates(view, region, cell, options)
    if len(candidates) < 6:
        raise InputError("first scan", f"{len(candidates)} vessel features on the cortex", "send a sharp, textured scan")
    return FirstView(grid, view, region, candidates)


def track(first: FirstView, later_scan: OrganisedScan, options: TrackingOptions | None = None) -> Tracking:
    """Find the first scan's vessel features in a later scan.

    Parameters
    ----------
    first
        From :func:`prepare_first`.
    later_scan
        Same tracker frame; the scanner may have moved.
    options
        Settings.
    """
    options = options or TrackingOptions()
    cell = first.grid.cell_m
    clock = time.perf_counter()
    later = view_scan(later_scan, first.grid)
    times = {"resample": time.perf_counter() - clock}

    clock = time.perf_counter()
    coarse = match_coarsely(first.view, later, first.region, cell, float(mm_to_m(options.reach_mm)))
    times["coarse"] = time.perf_counter() - clock

    clock = time.perf_counter()
    fine = _track_finely(first, later, coarse, options)
    times["fine"] = time.perf_counter() - clock

    clock = time.perf_counter()
    start, end = fine.start, fine.end
    lifted_start, slope_start, noise_start = lift(first.view.height, start, cell)
    lifted_end, slope_end, noise_end = lift(later.height, end, cell)
    shift = lifted_end - lifted_start
    across = np.sqrt(fine.variance)  # metres, one in-plane component
    along = noise_start**2 + noise_end**2 + (slope_end * across) ** 2 + 0.25 * (slope_start - slope_end) ** 2 * cell**2
    sigma = np.sqrt((2 * fine.variance + along) / 3 + (options.sigma_floor_cells * cell) ** 2)
    lifted = np.isfinite(shift).all(axis=1) & np.isfinite(sigma)
    kept = lifted.copy()
    kept[lifted] = consistent_points(lifted_start[lifted], shift[lifted], sigma[lifted])
    T_tracker_plane = invert_rigid(first.grid.T_plane_tracker)
    points = HomologousPoints(
        points=transform_points(T_tracker_plane, lifted_start[kept]),
        displacements=shift[kept] @ T_tracker_plane[:3, :3].T,
        sigma=sigma[kept],
    )
    times["lift"] = time.perf_counter() - clock
    warnings = []
    if len(points.points) < 20:
        warnings.append(f"only {len(points.points)} homologous points")
    return Tracking(
        points=points,
        correlation=fine.correlation[kept],
        forward_backward_m=fine.forward_backward_m[kept],
        diagnostics={
            "candidates": float(len(first.candidates)),
            "tracked": float(len(start)),
            "outliers": float(lifted.sum() - kept.sum()),
            "coarse_nodes": float(len(coarse.nodes)),
        },
        warnings=tuple(warnings),
        times_s=times,
    )


def _choose_candidates(
    view: PlaneView, region: NDArray[np.bool_], cell: float, options: TrackingOptions
) -> NDArray[np.float64]:
    """Two-dimensional structure on vessels (branches, bends, crossings), strongest first, at least a spacing apart."""
    strength = vesselness(view.texture * 0.15, cell)
    window = 2 * round(0.5 * float(mm_to_m(options.window_mm)) / cell) + 1
    corner = cv2.cornerMinEigenVal(cv2.GaussianBlur(view.texture, (0, 0), 0.35e-3 / cell), window, ksize=3)
    on_vessel = cv2.dilate((strength > 0.04).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    border = (
        2 * round((0.5 * float(mm_to_m(options.window_mm)) + _RIM_M) / cell) + 1
    )  # the rim hides and bares cortex as it moves
    inner = cv2.erode(region.astype(np.uint8), np.ones((border, border), np.uint8)) > 0
    corner = np.where(on_vessel & inner & view.seen, corner, 0.0)
    if corner.max() <= 0:
        return np.zeros((0, 2))
    corner[corner < 0.01 * np.quantile(corner[corner > 0], 0.99)] = 0.0
    # Strength is judged against the surroundings, so that a bundle of vessels does not take all the points.
    corner = corner / np.sqrt(cv2.GaussianBlur(corner, (0, 0), _SPREAD_M / cell) + 1e-12)
    radius = float(mm_to_m(options.spacing_mm)) / cell
    rows, columns = np.nonzero(corner)
    order = np.argsort(-corner[rows, columns], kind="stable")
    free = np.ones(corner.shape, dtype=np.uint8)
    chosen = []
    for k in order:
        if free[rows[k], columns[k]]:
            chosen.append((columns[k], rows[k]))
            cv2.circle(free, (int(columns[k]), int(rows[k])), int(np.ceil(radius)), 0, -1)
            if len(chosen) == options.most_points:
                break
    return np.array(chosen, dtype=np.float64)


@dataclass(frozen=True)
class _FineTracks:
    """Start and end (column, row) in cells, in-plane variance of a component in m^2, and the evidence."""

    start: NDArray[np.float64]
    end: NDArray[np.float64]
    variance: NDArray[np.float64]
    correlation: NDArray[np.float64]
    forward_backward_m: NDArray[np.float64]


def _track_finely(first: FirstView, later: PlaneView, coarse: CoarseShift, options: TrackingOptions) -> _FineTracks:
    """Pyramidal Lucas-Kanade from the coarse shift, and back again."""
    cell = first.grid.cell_m
    empty = np.zeros(0)
    if len(coarse.nodes) == 0:
        return _FineTracks(np.zeros((0, 2)), np.zeros((0, 2)), empty, empty, empty)
    a, b = (np.clip(128.0 + 31.0 * view.texture, 0, 255).astype(np.uint8) for view in (first.view, later))
    start = first.candidates.astype(np.float32)
    guess = (start + coarse.at(first.candidates)).astype(np.float32)
    side = 2 * round(0.5 * float(mm_to_m(options.window_mm)) / cell) + 1

    def lucas_kanade(
        source: NDArray, target: NDArray, points: NDArray[np.float32], start_from: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            source,
            target,
            points[:, None],
            start_from[:, None].copy(),
            winSize=(side, side),
            maxLevel=2,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.005),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return np.asarray(moved, dtype=np.float32)[:, 0], np.asarray(found).ravel() > 0

    end, found = lucas_kanade(a, b, start, guess)
    back, found_back = lucas_kanade(b, a, end, start + (end - guess))
    loop = np.linalg.norm(back - start, axis=1) * cell
    good = found & found_back & (loop < float(mm_to_m(options.forward_backward_mm)))
    tracks = []
    for k in np.flatnonzero(good):
        evidence = _window_evidence(first.view, later, start[k], end[k], side, cell)
        if evidence is not None and evidence[0] > options.least_correlation:
            tracks.append((k, *evidence))
    if not tracks:
        return _FineTracks(np.zeros((0, 2)), np.zeros((0, 2)), empty, empty, empty)
    kept, correlation, variance = (np.array(column) for column in zip(*tracks, strict=True))
    loop_kept = loop[kept].astype(np.float64)
    return _FineTracks(
        start[kept].astype(np.float64), end[kept].astype(np.float64), variance + 0.25 * loop_kept**2, correlation, loop_kept
    )


def _window_evidence(
    first: PlaneView, later: PlaneView, start: NDArray[np.float32], end: NDArray[np.float32], side: int, cell: float
) -> tuple[float, float] | None:
    """Correlation of the matched windows, and the variance of an in-plane component (m^2) by the structure tensor.

    Cramer-Rao for a shift: covariance = s^2 G^-1, G the sum of squared gradients over the window, s^2 the variance of the
    difference. Its noise is correlated over about 2 x 2 cells, hence the factor.
    """
    size = (side, side)
    center_a, center_b = (float(start[0]), float(start[1])), (float(end[0]), float(end[1]))
    patch_a, patch_b = cv2.getRectSubPix(first.texture, size, center_a), cv2.getRectSubPix(later.texture, size, center_b)
    seen_a = cv2.getRectSubPix(first.seen.astype(np.float32), size, center_a)
    seen_b = cv2.getRectSubPix(later.seen.astype(np.float32), size, center_b)
    valid = (seen_a > 0.9) & (seen_b > 0.9) & (patch_a != 0) & (patch_b != 0)
    if valid.mean() < 0.5:
        return None
    x, y = patch_a[valid] - patch_a[valid].mean(), patch_b[valid] - patch_b[valid].mean()
    correlation = float((x @ y) / max(float(np.sqrt((x @ x) * (y @ y))), 1e-9))
    gy, gx = np.gradient(0.5 * (patch_a + patch_b))
    gx, gy = gx[valid], gy[valid]
    tensor = np.array([[gx @ gx, gx @ gy], [gx @ gy, gy @ gy]]) + 1e-6 * np.eye(2)
    residual = float(np.mean((x - y) ** 2))
    covariance = 4.0 * residual * np.linalg.inv(tensor) * cell**2
    return correlation, float(np.trace(covariance) / 2)

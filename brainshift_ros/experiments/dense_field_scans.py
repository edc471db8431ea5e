"""Part of :mod:`brainshift_ros.experiments.dense_field`: the interpolation's error over distance, on simulated scans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from brainshift_ros.correspondence.dense import interpolate
from brainshift_ros.correspondence.error_growth import ErrorGrowth
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.correspondence.tracking import TrackingOptions, prepare_first, track
from brainshift_ros.geometry import transform_points
from brainshift_ros.registration.thinning import voxel_means
from brainshift_ros.simulation.scan_cases import ScanCase, make_scan_case
from brainshift_ros.simulation.scanner import Seen
from brainshift_ros.units import m_to_mm, mm_to_m
from brainshift_ros.vessels.tracing import trace_vessels, vessels_of_points

Progress = Callable[[str, float], None]
Row = dict[str, float | int | str]

#: Limits of the classes of distance to the nearest measured point, mm.
CLASSES_MM = (0.0, 2.0, 4.0, 6.0, 9.0, 13.0, 20.0, 30.0, 60.0)

#: Which of a case's homologous points are kept.
COVERAGES = ("all points", "15 points", "points on one side")

_SPACING_M = float(mm_to_m(2.0))
_FEW = 15
_LEAST = 40  # errors that make a share or a quantile worth drawing


@dataclass(frozen=True)
class Interpolated:
    """One case with one coverage.

    Attributes
    ----------
    case
        Number.
    coverage
        One of `COVERAGES`.
    points
        Number of measured points.
    distance_m, sigma_m
        Shape (m,), at the dense points.
    error_m
        Shape (m, 3), against the truth.
    growth
        As fitted to held-out points.
    """

    case: int
    coverage: str
    points: int
    distance_m: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    error_m: NDArray[np.float64]
    growth: ErrorGrowth


def interpolated_cases(numbers: Sequence[int], progress: Progress) -> list[Interpolated]:
    """Track every case, interpolate from all, few and one-sided points, and compare with the truth all over the cortex."""
    found = []
    for done, number in enumerate(numbers):
        progress("scans", done / len(numbers))
        found += _interpolated(number, make_scan_case(number))
    progress("scans", 1.0)
    return found


def table(found: Sequence[Interpolated]) -> list[Row]:
    """One row a case, coverage and class of distance: error, stated sigma, share of components within one sigma."""
    rows: list[Row] = []
    for item in found:
        classes = np.digitize(m_to_mm(item.distance_m), CLASSES_MM) - 1
        for number, (low, high) in enumerate(pairwise(CLASSES_MM)):
            own = classes == number
            if own.any():
                error, sigma = item.error_m[own], item.sigma_m[own]
                rows.append(
                    {
                        "case": item.case,
                        "coverage": item.coverage,
                        "measured_points": item.points,
                        "distance_mm": f"{low:g} to {high:g}",
                        "dense_points": int(own.sum()),
                        "error_mm_p68": float(m_to_mm(np.quantile(np.abs(error), 0.68))),
                        "sigma_mm_median": float(m_to_mm(np.median(sigma))),
                        "within_one_sigma": float(np.mean(np.abs(error) < sigma[:, None])),
                    }
                )
    return rows


def summary(found: Sequence[Interpolated]) -> Mapping[str, Mapping[str, float]]:
    """Calibration and fitted growth of each coverage."""
    told = {}
    for coverage in COVERAGES:
        own = [item for item in found if item.coverage == coverage]
        if own:
            scaled = np.concatenate([item.error_m / item.sigma_m[:, None] for item in own])
            length = np.concatenate([np.linalg.norm(item.error_m, axis=1) for item in own])
            growths = [item.growth for item in own]
            told[coverage] = {
                "cases": len(own),
                "measured_points_median": float(np.median([item.points for item in own])),
                "error_mm_median": float(m_to_mm(np.median(length))),
                "error_mm_p95": float(m_to_mm(np.quantile(length, 0.95))),
                "within_one_sigma": float(np.mean(np.abs(scaled) < 1.0)),
                "within_two_sigma": float(np.mean(np.abs(scaled) < 2.0)),
                "growth_floor_mm": float(m_to_mm(np.median([growth.floor_m for growth in growths]))),
                "growth_at_1cm_mm": float(m_to_mm(np.median([growth.at_1cm_m for growth in growths]))),
                "growth_power": float(np.median([growth.power for growth in growths])),
            }
    return told


def chart(found: Sequence[Interpolated]) -> Figure:
    """Draw error and stated sigma over distance, and how often the one covers the other."""
    coverages = [name for name in COVERAGES if any(item.coverage == name for item in found)]
    figure = Figure(figsize=(4.6 * len(coverages), 7.2), layout="constrained")
    axes = figure.subplots(2, len(coverages), sharex=True, sharey="row", squeeze=False)
    for column, coverage in enumerate(coverages):
        own = [item for item in found if item.coverage == coverage]
        distance = m_to_mm(np.concatenate([item.distance_m for item in own]))
        error = m_to_mm(np.abs(np.concatenate([item.error_m for item in own])))
        sigma = m_to_mm(np.concatenate([item.sigma_m for item in own]))
        held_distance, held_error = (m_to_mm(part) for part in _held_out(own))
        top, bottom = axes[:, column]
        middle, band = _binned(distance, sigma, lambda values: np.quantile(values, [0.1, 0.5, 0.9]))
        top.fill_between(middle, band[:, 0], band[:, 2], color="C0", alpha=0.2, label="stated sigma, 10 to 90 % of the points")
        top.plot(middle, band[:, 1], color="C0", label="stated sigma, median")
        top.plot(*_binned(distance, error, _p68), "o-", color="C3", label="true error, 68 % of components")
        top.plot(*_binned(distance, error, _p95), ":", color="C3", label="true error, 95 %")
        top.plot(*_binned(held_distance, np.abs(held_error), _p68), "x", color="0.3", label="held-out points, 68 %")
        count = np.median([item.points for item in own])
        top.set_title(f"{coverage}: {count:.0f} in the median of {len(own)} cases", fontsize=10)
        bottom.plot(*_binned(distance, error < sigma[:, None], np.mean), "s-", color="C0")
        bottom.axhline(0.683, color="0.3", linestyle="--", linewidth=0.9)
        bottom.set_xlabel("distance to the nearest measured point, mm")
        bottom.set_ylim(0.0, 1.0)
    for row in axes:
        for panel in row:
            panel.grid(visible=True, alpha=0.25)
    axes[0, 0].set_ylim(0.0, None)
    axes[0, 0].set_ylabel("one component of the displacement, mm")
    axes[1, 0].set_ylabel("share of components within one sigma\n(dashed: 68 %)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle(
        "thin-plate spline over the craniotomy: its error grows with the distance to what was measured", fontsize=11
    )
    return figure


def _p68(values: NDArray) -> float:
    return float(np.quantile(values, 0.68))


def _p95(values: NDArray) -> float:
    return float(np.quantile(values, 0.95))


def _held_out(own: Sequence[Interpolated]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances (k,) and errors (k, 3), metres, of the points that the growth was fitted to."""
    grown = [(item.growth.distances_m, item.growth.errors_m) for item in own]
    kept = [(d, e) for d, e in grown if d is not None and e is not None]
    if not kept:
        return np.zeros(0), np.zeros((0, 3))
    return np.concatenate([d for d, _ in kept]), np.concatenate([e for _, e in kept])


def _binned(
    distance_mm: NDArray[np.float64], values: NDArray, measure: Callable[[NDArray], NDArray | float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Median distance of each class that holds enough values, and a measure of them."""
    middle, measured = [], []
    for low, high in pairwise(CLASSES_MM):
        own = (distance_mm >= low) & (distance_mm < high)
        if own.sum() >= _LEAST:
            middle.append(float(np.median(distance_mm[own])))
            measured.append(measure(values[own]))
    return np.array(middle), np.array(measured)


def _interpolated(number: int, case: ScanCase) -> list[Interpolated]:
    options = TrackingOptions()
    scan = case.first.scan
    cortex = (case.first.label == Seen.CORTEX) & scan.seen
    tracking = track(prepare_first(scan, cortex, options), case.later.scan, options)
    vessels = vessels_of_points(trace_vessels(scan, cortex), scan, tracking.points.points)
    T = case.T_patient_tracker
    measured = HomologousPoints(
        transform_points(T, tracking.points.points), tracking.points.displacements @ T[:3, :3].T, tracking.points.sigma
    )
    at = voxel_means(case.first.current[cortex], _SPACING_M)[0]
    at = at[case.is_lasting_cortex(at)]
    truth = case.shift(at)
    found = []
    for coverage, kept in _coverages(case, measured.points, np.random.default_rng([number, 54])).items():
        some = HomologousPoints(measured.points[kept], measured.displacements[kept], measured.sigma[kept])
        # What the tracker adds to every point alike.
        common_m = float(mm_to_m(options.tracker_mm)) * float(np.sqrt(2.0 / 3.0))
        dense = interpolate(some, at, vessel_ids=vessels[kept], common_m=common_m)
        error = dense.displacements - truth
        found.append(Interpolated(number, coverage, int(kept.sum()), dense.distance_m, dense.sigma, error, dense.growth))
    return found


def _coverages(case: ScanCase, points: NDArray[np.float64], rng: np.random.Generator) -> Mapping[str, NDArray[np.bool_]]:
    few = np.zeros(len(points), dtype=bool)
    few[rng.permutation(len(points))[:_FEW]] = True
    angle = rng.uniform(0.0, 2 * np.pi)
    across = transform_points(case.scene.craniotomy.T_craniotomy_patient, points)[:, :2] @ [np.cos(angle), np.sin(angle)]
    return dict(zip(COVERAGES, (np.ones(len(points), dtype=bool), few, across < np.median(across)), strict=True))

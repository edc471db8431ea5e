"""Does a scan's texture hold it against sliding better than its shape does? Dark sulci against how open the cortex is.

The registered scan is slid along the surface around its true place; at each offset the texture (correlation of the picture's
darkness with the cortex's hiddenness) and the shape (robust fit) are scored. The simulator paints sulci dark where the true
surface is deep, and shades by its normals: the texture is at its best here.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.geometry import tangent_frame
from brainshift_ros.registration.exposure import open_fraction
from brainshift_ros.registration.icp import fit_scores
from brainshift_ros.registration.opening import opening_mask
from brainshift_ros.registration.patch import OrientedPoints, ScanPatch, scan_patch
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.simulation.scan_cases import ScanCase, make_scan_case
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]

REACH_MM, STEP_MM = 8.0, 0.5
_SPACING_M, _FIT_M = 1e-3, 2e-3
_POINTS = 1200


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Slide scans over the cortex and see where texture and shape fit best.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv (a row a scan) and scan_texture.png.
    full
        Eighteen scans instead of six.
    progress
        Called with stage and fraction done.
    """
    numbers = range(0, 36, 2) if full else range(0, 36, 6)
    steps = np.arange(-REACH_MM, REACH_MM + STEP_MM / 2, STEP_MM)
    rows: list[dict[str, Any]] = []
    maps = []
    for done, number in enumerate(numbers):
        progress("sliding scans", done / len(numbers))
        case = make_scan_case(number)
        texture, shape = score_maps(case, steps)
        maps.append((texture, shape))
        rows.append(
            {
                "scan": case.name,
                "texture, peak off the truth, mm": _peak_mm(texture, steps),
                "shape, peak off the truth, mm": _peak_mm(shape, steps),
                "texture, correlation at its peak": float(texture.max()),
                "texture, correlation at the truth": float(texture[len(steps) // 2, len(steps) // 2]),
            }
        )
    progress("sliding scans", 1.0)
    names = [name for name in rows[0] if name != "scan"]
    summary = {"scans": len(rows), "median": {name: float(np.median([row[name] for row in rows])) for name in names}}
    write_results(folder, summary, rows)
    write_figure(folder / "scan_texture.png", chart(maps[0], rows))
    return summary


def score_maps(case: ScanCase, steps_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Scores (n, n) of texture and shape, the true pose slid by `steps_mm` (n,) along two tangents."""
    target = prepare_target(case.cortex)
    hidden = -open_fraction(case.cortex, target.points, target.normals, directions=64)
    scan = case.first.scan
    patch = scan_patch(scan, opening_mask(scan), _SPACING_M)
    chosen = np.sort(np.random.default_rng(0).permutation(np.flatnonzero(patch.oriented))[:_POINTS])
    cloud = OrientedPoints(patch.points.reshape(-1, 3)[chosen], patch.normals.reshape(-1, 3)[chosen])
    dark = _darkness(scan, patch).reshape(-1)[chosen]
    first, second, _ = tangent_frame(case.T_patient_tracker[:3, :3] @ cloud.normals.mean(axis=0))
    texture, shape = np.empty((2, len(steps_mm), len(steps_mm)))
    for i, along in enumerate(mm_to_m(steps_mm)):
        poses = np.tile(case.T_patient_tracker, (len(steps_mm), 1, 1))
        poses[:, :3, 3] += along * first + mm_to_m(steps_mm)[:, None] * second
        shape[i] = fit_scores(cloud, target, poses, _FIT_M)
        texture[i] = [_correlation(dark, hidden[_nearest(target, cloud, pose)]) for pose in poses]
    return texture, shape


def _darkness(scan: OrganisedScan, patch: ScanPatch) -> NDArray[np.float64]:
    """Negative logarithm of the green channel over each block (h, w), its slow change (lighting) taken out."""
    height, width = patch.points.shape[:2]
    crop = scan.rgb[: height * patch.block, : width * patch.block, 1]
    green = cv2.resize(crop, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    logarithm = np.log(green + 4.0)
    sigma = 8e-3 / patch.spacing_m
    return np.asarray(cv2.GaussianBlur(logarithm, (0, 0), sigma) - logarithm, dtype=np.float64)


def _nearest(target: CortexTarget, cloud: OrientedPoints, pose: NDArray[np.float64]) -> NDArray[np.int32]:
    return target.grid.lookup(cloud.points @ pose[:3, :3].T + pose[:3, 3])


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.corrcoef(a, b)[0, 1])


def _peak_mm(scores: NDArray[np.float64], steps_mm: NDArray[np.float64]) -> float:
    i, j = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return float(np.hypot(steps_mm[i], steps_mm[j]))


def chart(maps: tuple[NDArray[np.float64], NDArray[np.float64]], rows: list[dict[str, Any]]) -> Figure:
    """Draw both scores of the first scan over the offset, and how far off the peaks of all scans are."""
    figure = Figure(figsize=(13, 4), layout="constrained")
    axes = figure.subplots(1, 3)
    for at, values, name in zip(axes, maps, ("texture: correlation", "shape: robust fit"), strict=False):
        picture = at.imshow(values.T, origin="lower", extent=(-REACH_MM, REACH_MM, -REACH_MM, REACH_MM))
        at.plot(0, 0, "r+")
        at.set_title(f"{rows[0]['scan']}, {name}", fontsize=9)
        at.set_xlabel("slid along the surface, mm")
        figure.colorbar(picture, ax=at)
    for name, marker in (("texture", "s"), ("shape", "o")):
        axes[2].plot([row[f"{name}, peak off the truth, mm"] for row in rows], marker, label=name)
    axes[2].set_xticks(range(len(rows)), [row["scan"] for row in rows], rotation=90, fontsize=7)
    axes[2].set_title(f"distance of the peak from the truth, mm (grid of {STEP_MM:g} mm)", fontsize=9)
    axes[2].grid(visible=True, alpha=0.3)
    axes[2].legend()
    return figure

"""Traced vessels against those that the simulator painted, in the plane of the craniotomy (material coordinates)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.geometry import transform_points
from brainshift_ros.simulation.scanner import SimulatedScan
from brainshift_ros.simulation.scene import SurgicalScene
from brainshift_ros.simulation.vessels import PaintedVessel
from brainshift_ros.units import m_to_mm
from brainshift_ros.vessels.tracing import VesselTree

#: A traced centre line this close to a painted one is on it.
NEAR_M = 0.5e-3

#: A traced branch point this close to a painted one is that one: thinning moves it by about the width of its vessels.
BRANCH_NEAR_M = 1.5e-3

#: Classes of drawn width by their limits, metres.
WIDTH_CLASSES: Mapping[str, tuple[float, float]] = {
    "< 0.6 mm": (0.0, 0.6e-3),
    "to 0.9 mm": (0.6e-3, 0.9e-3),
    "to 1.3 mm": (0.9e-3, 1.3e-3),
    "> 1.3 mm": (1.3e-3, np.inf),
}

#: The simulator's painter, OpenCV's smooth lines in short pieces, draws vessels this much wider than it is asked.
DRAWN_WIDER_M = 0.25e-3

_STEP_M = 0.1e-3
_SEEN_M = 0.35e-3
_RIM_M = 1.5e-3


@dataclass(frozen=True)
class PaintedTruth:
    """Painted vessels that a scan shows.

    Attributes
    ----------
    xy
        Shape (H, W, 2), craniotomy coordinates of each pixel's tissue, metres, NaN off the cortex.
    judged
        Shape (H, W): cortex without its rim, where tracing is not asked for.
    lines
        Shape (n, 2), points every 0.1 mm on the centre lines that lie in judged pixels, metres.
    width
        Shape (n,), as drawn, metres.
    branches, crossings
        Shapes (b, 2) and (c, 2): where branches leave, and where vessels only run over each other.
    """

    xy: NDArray[np.float64]
    judged: NDArray[np.bool_]
    lines: NDArray[np.float64]
    width: NDArray[np.float64]
    branches: NDArray[np.float64]
    crossings: NDArray[np.float64]

    def on_vessel(self) -> NDArray[np.bool_]:
        """Pixels (H, W) whose tissue is painted as vessel."""
        mask = np.zeros(self.judged.shape, dtype=bool)
        distance, index = cKDTree(self.lines).query(self.xy[self.judged])
        mask[self.judged] = distance <= 0.5 * self.width[index]
        return mask

    def found(self, tree: VesselTree) -> NDArray[np.bool_]:
        """Which points of `lines` a traced centre line reaches, shape (n,)."""
        traced = self.xy[_judged_pixels(tree, self)]
        if len(traced) == 0:
            return np.zeros(len(self.lines), dtype=bool)
        return np.asarray(cKDTree(traced).query(self.lines)[0] < NEAR_M)

    def missed_pixels(self, tree: VesselTree) -> NDArray[np.intp]:
        """Pixels (k, 2), (row, column), of the painted lines that were not found."""
        shown = np.argwhere(self.judged)
        return np.asarray(shown[cKDTree(self.xy[self.judged]).query(self.lines[~self.found(tree)])[1]])


def painted_truth(scene: SurgicalScene, scanned: SimulatedScan, region: NDArray[np.bool_]) -> PaintedTruth:
    """Find which painted vessels lie in the pixels `region` (H, W) of a scan."""
    cortex = np.isfinite(scanned.material).all(axis=-1) & region
    pixel_m = float(np.sqrt(_area(scene, scanned, cortex) / cortex.sum()))
    size = 2 * max(1, round(_RIM_M / pixel_m)) + 1
    judged = cv2.erode(cortex.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0
    xy = transform_points(scene.craniotomy.T_craniotomy_patient, scanned.material)[..., :2]
    seen = cKDTree(xy[judged])

    def shown(at: NDArray[np.float64]) -> NDArray[np.bool_]:
        return seen.query(at)[0] < _SEEN_M

    dense = [_resampled(vessel) for vessel in scene.vessels]
    lines, width = np.concatenate([line for line, _ in dense]), np.concatenate([wide for _, wide in dense])
    kept = shown(lines)
    # Fine vessels hang on no tree, so their origin is no branch point.
    trees = [cKDTree(line) for line, _ in dense]
    origins = np.array([vessel.path[0] for vessel in scene.vessels])
    leaves = [
        any(tree.query(origin)[0] < _STEP_M for other, tree in enumerate(trees) if other != number)
        for number, origin in enumerate(origins)
    ]
    branches = origins[np.array(leaves)].reshape(-1, 2)
    crossings = _crossings([line for line, _ in dense], branches)
    return PaintedTruth(xy, judged, lines[kept], width[kept], branches[shown(branches)], crossings[shown(crossings)])


def score_tree(tree: VesselTree, truth: PaintedTruth) -> dict[str, float]:
    """Recall and precision of centre lines and branch points, and the error of widths.

    Returns
    -------
    dict
        ``recall`` (also by class of width) and ``precision`` of centre lines within 0.5 mm; ``branch_recall`` of painted
        branches and ``branch_precision`` against branches and crossings within 1.5 mm; ``offset_mm`` (median distance of a
        traced centre line that is right), ``width_error_mm`` (median of measured minus painted) and
        ``width_error_mm_p84`` (84th percentile of its size).
    """
    pixels = _judged_pixels(tree, truth)
    measured = np.concatenate([path.width_m for path in tree.paths])[_judged(tree, truth)]
    to_truth, index = cKDTree(truth.lines).query(truth.xy[pixels])
    found = truth.found(tree)
    right = to_truth < NEAR_M
    width_error = m_to_mm(measured[right] - truth.width[index[right]])
    rows, columns = np.round(tree.branch_points).astype(np.intp).reshape(-1, 2).T
    inside = truth.judged[rows, columns]
    branch_points = truth.xy[rows[inside], columns[inside]]
    anything = np.concatenate([truth.branches, truth.crossings])
    by_class = {
        f"recall, {name}": float(found[(truth.width > low) & (truth.width <= high)].mean())
        for name, (low, high) in WIDTH_CLASSES.items()
    }
    return {
        "recall": float(found.mean()),
        **by_class,
        "precision": float(right.mean()),
        "offset_mm": float(m_to_mm(np.median(to_truth[right]))),
        "branch_recall": _near_share(truth.branches, branch_points),
        "branch_precision": _near_share(branch_points, anything),
        "width_error_mm": float(np.median(width_error)),
        "width_error_mm_p84": float(np.quantile(np.abs(width_error), 0.84)),
        "length_mm": float(m_to_mm(tree.length_m)),
        "branch_points": float(len(tree.branch_points)),
    }


def _judged(tree: VesselTree, truth: PaintedTruth) -> NDArray[np.bool_]:
    pixels = np.concatenate([np.zeros((0, 2)), *(path.pixels for path in tree.paths)]).astype(np.intp)
    return truth.judged[pixels[:, 0], pixels[:, 1]]


def _judged_pixels(tree: VesselTree, truth: PaintedTruth) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the traced pixels that count."""
    pixels = np.concatenate([np.zeros((0, 2)), *(path.pixels for path in tree.paths)]).astype(np.intp)
    rows, columns = pixels[_judged(tree, truth)].T
    return rows, columns


def _near_share(points: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    if len(points) == 0 or len(others) == 0:
        return float("nan")
    return float(np.mean(cKDTree(others).query(points)[0] < BRANCH_NEAR_M))


def _area(scene: SurgicalScene, scanned: SimulatedScan, cortex: NDArray[np.bool_]) -> float:
    """Area that the pixels cover in the craniotomy's plane, by counting cells of half a millimetre."""
    xy = transform_points(scene.craniotomy.T_craniotomy_patient, scanned.material[cortex])[:, :2]
    return len(np.unique(np.floor(xy / 0.5e-3), axis=0)) * 0.5e-3**2


def _resampled(vessel: PaintedVessel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(vessel.path, axis=0), axis=1))]
    at = np.arange(0.0, along[-1], _STEP_M)
    line = np.stack([np.interp(at, along, vessel.path[:, axis]) for axis in range(2)], axis=-1)
    return line, np.interp(at, along, vessel.width) + DRAWN_WIDER_M


def _crossings(lines: list[NDArray[np.float64]], branches: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where two centre lines meet that are not branch and trunk, one point a meeting."""
    meetings = []
    trees = [cKDTree(line) for line in lines]
    for number, line in enumerate(lines):
        for other in trees[number + 1 :]:
            close = line[other.query(line, distance_upper_bound=1.5 * _STEP_M)[0] < 1.5 * _STEP_M]
            if len(close):
                apart = np.linalg.norm(np.diff(close, axis=0), axis=1) > BRANCH_NEAR_M
                meetings += [part.mean(axis=0) for part in np.split(close, np.flatnonzero(apart) + 1)]
    found = np.array(meetings).reshape(-1, 2)
    if len(branches) == 0 or len(found) == 0:
        return found
    return found[cKDTree(branches).query(found)[0] > BRANCH_NEAR_M]

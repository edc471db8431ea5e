"""Vessels traced in the texture of a scan: centre lines, branch points, ends, widths."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.filters import apply_hysteresis_threshold
from skimage.graph import MCP_Geometric
from skimage.morphology import skeletonize

from brainshift_ros.correspondence.speculars import repair_speculars
from brainshift_ros.correspondence.vesselness import blood_contrast, vessel_width, vesselness
from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan

_WEAK, _STRONG = 0.05, 0.11  # vessel contrast in logarithmic intensity
_SHORTEST_M = 3.0e-3
_LONGEST_GAP_M = 4.0e-3
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)


@dataclass(frozen=True)
class VesselPath:
    """A stretch of vessel between two ends or branch points.

    Attributes
    ----------
    pixels
        Shape (n, 2), (row, column), from one end to the other.
    width_m
        Shape (n,), metres.
    confidence
        0 to 1: mean vesselness along the path against a clear vessel's.
    bridged
        True where the path joins two vessels across a gap.
    """

    pixels: NDArray[np.float64]
    width_m: NDArray[np.float64]
    confidence: float
    bridged: bool


@dataclass(frozen=True)
class VesselTree:
    """All vessels of a scan, in pixels of its texture.

    Attributes
    ----------
    paths
        Stretches of vessel.
    branch_points, ends
        Shapes (b, 2) and (e, 2), (row, column).
    strength
        Shape (H, W), vesselness.
    pixel_m
        Spacing of neighbouring pixels on the cortex, metres.
    """

    paths: tuple[VesselPath, ...]
    branch_points: NDArray[np.float64]
    ends: NDArray[np.float64]
    strength: NDArray[np.float32]
    pixel_m: float

    @property
    def length_m(self) -> float:
        """Total length of all paths, metres."""
        steps = sum(np.linalg.norm(np.diff(path.pixels, axis=0), axis=1).sum() for path in self.paths)
        return float(steps * self.pixel_m)


def trace_vessels(scan: OrganisedScan, region: NDArray[np.bool_] | None = None) -> VesselTree:
    """Find vessels without given ends.

    Parameters
    ----------
    scan
        Organised scan; its texture is repaired where it glints.
    region
        Shape (H, W): where to look (the cortex); everywhere by default.
    """
    region = np.ones(scan.rgb.shape[:2], dtype=bool) if region is None else region
    spacing = pixel_spacing(scan)
    repaired, _ = repair_speculars(scan.rgb)
    weight = cv2.erode(_fill_small_holes(region, spacing).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    flat = blood_contrast(repaired, weight, 4e-3 / spacing)
    strength, width = vesselness(flat, spacing), vessel_width(flat, spacing)
    margin = cv2.erode(weight, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(1, round(1e-3 / spacing)) + 1,) * 2))
    strength *= margin
    mask = apply_hysteresis_threshold(strength, _WEAK, _STRONG)
    skeleton = skeletonize(mask)
    labels, count = ndimage.label(skeleton, structure=np.ones((3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    skeleton &= sizes[labels] >= _SHORTEST_M / spacing
    skeleton = _prune(skeleton, round(1.2e-3 / spacing))
    paths, branch_points, ends = _skeleton_graph(skeleton, strength, width)
    bridges = _bridge_gaps(ends, skeleton, strength, width, _LONGEST_GAP_M / spacing)
    return VesselTree((*paths, *bridges), branch_points, ends, strength, spacing)


def trace_between(strength: NDArray[np.float32], start: tuple[int, int], end: tuple[int, int]) -> NDArray[np.float64]:
    """Minimal path between two given pixels (semi-automatic tracing, thesis fig. 55).

    The cost of a pixel falls with its vesselness, so the path follows the vessel rather than the chord.

    Parameters
    ----------
    strength
        Shape (H, W), vesselness.
    start, end
        (row, column).

    Returns
    -------
    pixels
        Shape (n, 2), (row, column), from start to end.
    """
    clear = max(float(np.quantile(strength, 0.99)), _STRONG)
    cost = 1.0 / (0.02 + np.clip(strength / clear, 0.0, 1.0) ** 2)
    search = MCP_Geometric(cost)
    search.find_costs([start], [end])
    return np.array(search.traceback(end), dtype=np.float64)


def _fill_small_holes(region: NDArray[np.bool_], spacing: float) -> NDArray[np.bool_]:
    """Dropouts of the range are no reason to ignore the texture."""
    size = 2 * max(1, round(2e-3 / spacing)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    padded = np.pad(region.astype(np.uint8), size)
    return cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)[size:-size, size:-size] > 0


def _degree(skeleton: NDArray[np.bool_]) -> NDArray[np.uint8]:
    ones = skeleton.astype(np.uint8)
    return np.asarray(cv2.filter2D(ones, -1, _NEIGHBOURS, borderType=cv2.BORDER_CONSTANT) * ones, dtype=np.uint8)


def _split(skeleton: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int, NDArray[np.bool_]]:
    """Links of the skeleton, labelled, once its junctions are taken out."""
    junction = cv2.dilate((_degree(skeleton) >= 3).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    junction &= skeleton
    labels, count = ndimage.label(skeleton & ~junction, structure=np.ones((3, 3)))
    return labels, count, junction


def _prune(skeleton: NDArray[np.bool_], shortest_px: int) -> NDArray[np.bool_]:
    """Remove side spurs shorter than a vessel's width: artefacts of thinning, not branches."""
    labels, count, junction = _split(skeleton)
    if count == 0:
        return skeleton
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    has_end = np.zeros(count + 1, dtype=bool)
    has_end[labels[_degree(skeleton) == 1]] = True
    near_junction = np.zeros(count + 1, dtype=bool)
    near_junction[labels[cv2.dilate(junction.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0]] = True
    spur = has_end & near_junction & (sizes < shortest_px)
    spur[0] = False
    return skeletonize(skeleton & ~spur[labels])


def _ordered(pixels: NDArray[np.intp]) -> NDArray[np.float64]:
    """Pixels of one simple skeleton link in walking order."""
    remaining = {(int(r), int(c)) for r, c in pixels}

    def neighbours(at: tuple[int, int]) -> list[tuple[int, int]]:
        r, c = at
        near = ((r, c + 1), (r, c - 1), (r + 1, c), (r - 1, c), (r + 1, c + 1), (r + 1, c - 1), (r - 1, c + 1), (r - 1, c - 1))
        return [p for p in near if p in remaining]

    at = min(sorted(remaining), key=lambda p: len(neighbours(p)))
    walk = [at]
    remaining.discard(at)
    while following := neighbours(at):
        at = following[0]
        walk.append(at)
        remaining.discard(at)
    return np.array(walk, dtype=np.float64)


def _skeleton_graph(
    skeleton: NDArray[np.bool_], strength: NDArray[np.float32], width: NDArray[np.float32]
) -> tuple[list[VesselPath], NDArray[np.float64], NDArray[np.float64]]:
    """Links, junction centres and free ends of a skeleton."""
    labels, _, junction = _split(skeleton)
    paths = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        pixels = np.argwhere(labels[box] == number) + np.array([box[0].start, box[1].start])
        if len(pixels) >= 3:
            paths.append(_path(_ordered(pixels), strength, width, bridged=False))
    clusters, junctions = ndimage.label(junction, structure=np.ones((3, 3)))
    centers = ndimage.center_of_mass(junction, clusters, range(1, junctions + 1))
    ends = np.argwhere(_degree(skeleton) == 1)
    return paths, np.array(centers, dtype=np.float64).reshape(-1, 2), ends.astype(np.float64)


def _path(
    pixels: NDArray[np.float64], strength: NDArray[np.float32], width: NDArray[np.float32], *, bridged: bool
) -> VesselPath:
    r, c = pixels.astype(np.intp).T
    confidence = float(np.clip(strength[r, c].mean() / (2 * _STRONG), 0.0, 1.0))
    return VesselPath(pixels, width[r, c].astype(np.float64), confidence, bridged)


def _bridge_gaps(
    ends: NDArray[np.float64],
    skeleton: NDArray[np.bool_],
    strength: NDArray[np.float32],
    width: NDArray[np.float32],
    longest_px: float,
) -> list[VesselPath]:
    """Join free ends to the nearest end of another vessel by a minimal path, where the picture supports a vessel between."""
    if len(ends) < 2:
        return []
    components, _ = ndimage.label(skeleton, structure=np.ones((3, 3)))
    own = components[ends[:, 0].astype(int), ends[:, 1].astype(int)]
    distance = np.linalg.norm(ends[:, None] - ends[None], axis=-1)
    distance[own[:, None] == own[None]] = np.inf
    nearest = distance.argmin(axis=1)
    bridges = []
    for a, b in enumerate(nearest):
        if distance[a, b] > longest_px or (nearest[b] == a and b < a):
            continue
        low = np.maximum(np.minimum(ends[a], ends[b]) - 8, 0).astype(int)
        high = (np.maximum(ends[a], ends[b]) + 9).astype(int)
        window = strength[low[0] : high[0], low[1] : high[1]]
        start, end = ends[a].astype(int) - low, ends[b].astype(int) - low
        pixels = trace_between(window, (int(start[0]), int(start[1])), (int(end[0]), int(end[1]))) + low
        r, c = pixels.astype(np.intp).T
        if strength[r, c].mean() > 0.6 * _WEAK:
            bridges.append(_path(pixels, strength, width, bridged=True))
    return bridges

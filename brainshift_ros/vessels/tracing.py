"""Vessels traced in the texture of a scan: centre lines, branch points, ends, widths."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.filters import apply_hysteresis_threshold
from skimage.morphology import skeletonize

from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.vessels.gaps import bridge_gaps
from brainshift_ros.vessels.minimal_path import CLEAR_STRENGTH
from brainshift_ros.vessels.skeleton import take_apart, thin
from brainshift_ros.vessels.speculars import repair_speculars
from brainshift_ros.vessels.vesselness import blood_contrast, vesselness
from brainshift_ros.vessels.width import widths_across

_WEAK, _STRONG = 0.025, 0.05  # vessel contrast in logarithmic intensity
_RED_SHARE = 0.9  # a shadow as dark as 0.45 of its surround is no vessel
_LIGHT_SIGMA_M = 4.0e-3
_MARGIN_M = 1.0e-3  # the rim of the cortex is darker than it, like a vessel
_SHORTEST_M = 3.0e-3
_SHORTEST_SPUR_M = 1.2e-3
_LONGEST_GAP_M = 4.0e-3
_BRIDGE_STRENGTH = 0.018
_ON_VESSEL_M = 2.0e-3


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
        True where most of the path crosses a gap.
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
        Shape (H, W), vesselness; zero where vessels were not looked for.
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


@dataclass(frozen=True)
class VesselImage:
    """What a scan's texture shows of vessels, pixel by pixel.

    Attributes
    ----------
    strength
        Shape (H, W), vesselness.
    flat
        Shape (H, W), blood contrast.
    glint
        Shape (H, W), pixels repaired because they glint.
    pixel_m
        Spacing of neighbouring pixels, metres.
    """

    strength: NDArray[np.float32]
    flat: NDArray[np.float32]
    glint: NDArray[np.bool_]
    pixel_m: float


def enhance_vessels(scan: OrganisedScan, region: NDArray[np.bool_] | None = None) -> VesselImage:
    """Repair glints and measure vesselness.

    Parameters
    ----------
    scan
        Organised scan.
    region
        Shape (H, W): where to look (the cortex); everywhere by default.
    """
    region = np.ones(scan.rgb.shape[:2], dtype=bool) if region is None else region
    spacing = pixel_spacing(scan)
    repaired, glint = repair_speculars(scan.rgb)
    weight = cv2.erode(_fill_small_holes(region, spacing).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    flat = blood_contrast(repaired, weight, _LIGHT_SIGMA_M / spacing, _RED_SHARE)
    size = 2 * max(1, round(_MARGIN_M / spacing)) + 1
    inner = cv2.erode(weight, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    return VesselImage(vesselness(flat, spacing) * inner, flat, glint, spacing)


def trace_vessels(scan: OrganisedScan, region: NDArray[np.bool_] | None = None) -> VesselTree:
    """Find vessels without given ends.

    Parameters
    ----------
    scan
        Organised scan; its texture is repaired where it glints.
    region
        Shape (H, W): where to look (the cortex); everywhere by default.
    """
    image = enhance_vessels(scan, region)
    strength, spacing = image.strength, image.pixel_m
    mask = apply_hysteresis_threshold(strength, _WEAK, _STRONG)
    line = thin(mask, _SHORTEST_M / spacing, _SHORTEST_SPUR_M / spacing)
    bridges = bridge_gaps(line, strength, image.glint, _LONGEST_GAP_M / spacing, _BRIDGE_STRENGTH)
    graph = take_apart(np.asarray(skeletonize(line | bridges), dtype=bool))
    paths = tuple(_path(pixels, image, bridges) for pixels in graph.links)
    return VesselTree(paths, graph.junctions, graph.ends, strength, spacing)


def vessels_of_points(tree: VesselTree, scan: OrganisedScan, points: NDArray[np.float64]) -> NDArray[np.intp]:
    """Which vessel each point lies on.

    Parameters
    ----------
    tree
        Traced in `scan`.
    scan
        In the frame of the points.
    points
        Shape (n, 3), metres.

    Returns
    -------
    ids
        Shape (n,), index in ``tree.paths`` of the nearest one; -1 where none was seen within 2 mm.
    """
    ids = np.full(len(points), -1, dtype=np.intp)
    if not tree.paths:
        return ids
    owner = np.repeat(np.arange(len(tree.paths)), [len(path.pixels) for path in tree.paths])
    rows, columns = np.concatenate([path.pixels for path in tree.paths]).astype(np.intp).T
    places = scan.points[rows, columns].astype(np.float64)
    seen = np.isfinite(places).all(axis=1)
    if seen.any():
        distance, nearest = cKDTree(places[seen]).query(points)
        on = distance < _ON_VESSEL_M
        ids[on] = owner[seen][nearest[on]]
    return ids


def _path(pixels: NDArray[np.float64], image: VesselImage, bridges: NDArray[np.bool_]) -> VesselPath:
    rows, columns = pixels.astype(np.intp).T
    confidence = float(np.clip(image.strength[rows, columns].mean() / CLEAR_STRENGTH, 0.0, 1.0))
    bridged = bool(bridges[rows, columns].mean() > 0.5)
    return VesselPath(pixels, widths_across(image.flat, pixels, image.pixel_m), confidence, bridged)


def _fill_small_holes(region: NDArray[np.bool_], spacing: float) -> NDArray[np.bool_]:
    """Dropouts of the range are no reason to ignore the texture."""
    size = 2 * max(1, round(2e-3 / spacing)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    padded = np.pad(region.astype(np.uint8), size)
    return cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)[size:-size, size:-size] > 0

"""Skeletons one pixel wide: their links, junctions and ends."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.morphology import skeletonize

_EIGHT = np.ones((3, 3), dtype=np.uint8)
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
_LEAST_LINK_PX = 3


@dataclass(frozen=True)
class SkeletonGraph:
    """A skeleton taken apart.

    Attributes
    ----------
    links
        Shape (n, 2) each: (row, column) of the pixels between two junctions or ends, in walking order.
    junctions, ends
        Shapes (b, 2) and (e, 2), (row, column).
    """

    links: tuple[NDArray[np.float64], ...]
    junctions: NDArray[np.float64]
    ends: NDArray[np.float64]


def thin(mask: NDArray[np.bool_], shortest_px: float, shortest_spur_px: float) -> NDArray[np.bool_]:
    """Skeleton of a mask without pieces and side spurs that are too short to mean anything.

    Parameters
    ----------
    mask
        Shape (H, W).
    shortest_px
        Connected pieces with fewer pixels are dropped.
    shortest_spur_px
        Links with a free end and fewer pixels are artefacts of thinning a wide vessel, not branches.
    """
    skeleton = skeletonize(mask)
    labels, count = ndimage.label(skeleton, structure=_EIGHT)
    skeleton &= np.bincount(labels.ravel(), minlength=count + 1)[labels] >= shortest_px
    labels, count, junction = _split(skeleton)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    has_end, at_junction = np.zeros(count + 1, dtype=bool), np.zeros(count + 1, dtype=bool)
    has_end[labels[_degree(skeleton) == 1]] = True
    at_junction[labels[_grown(junction)]] = True
    spur = has_end & at_junction & (sizes < shortest_spur_px)
    spur[0] = False
    return np.asarray(skeletonize(skeleton & ~spur[labels]), dtype=bool)


def take_apart(skeleton: NDArray[np.bool_]) -> SkeletonGraph:
    """Links, junctions and ends of a skeleton; links of one or two pixels are left out."""
    labels, _, junction = _split(skeleton)
    links = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        pixels = np.argwhere(labels[box] == number)
        if len(pixels) >= _LEAST_LINK_PX:
            links.append(_walk(pixels + np.array([box[0].start, box[1].start])))
    clusters, count = ndimage.label(junction, structure=_EIGHT)
    junctions = np.array(ndimage.center_of_mass(junction, clusters, range(1, count + 1)), dtype=np.float64)
    return SkeletonGraph(tuple(links), junctions.reshape(-1, 2), free_ends(skeleton))


def free_ends(skeleton: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Pixels (n, 2), (row, column), with one neighbour."""
    return np.argwhere(_degree(skeleton) == 1).astype(np.float64)


def _degree(skeleton: NDArray[np.bool_]) -> NDArray[np.uint8]:
    ones = skeleton.astype(np.uint8)
    return np.asarray(cv2.filter2D(ones, -1, _NEIGHBOURS, borderType=cv2.BORDER_CONSTANT) * ones, dtype=np.uint8)


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _EIGHT) > 0)


def _split(skeleton: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int, NDArray[np.bool_]]:
    """Links, labelled, and the junctions between them."""
    junction = _grown(_degree(skeleton) >= 3) & skeleton
    labels, count = ndimage.label(skeleton & ~junction, structure=_EIGHT)
    return labels, count, junction


def _walk(pixels: NDArray[np.intp]) -> NDArray[np.float64]:
    """Pixels of one simple link in walking order."""
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

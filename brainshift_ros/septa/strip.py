"""Strips that carry a septum's attached edge out of the brain, however exactly that edge was found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.geometry import unit
from brainshift_ros.image.resample import sample
from brainshift_ros.image.volume import Volume
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm, mm_to_m

#: Width of the strips. A registration may be off by 3 mm, an edge that was drawn on the skull's inner side by 2 mm.
STRIP_MM = 6.0

#: Standard deviation of the blur that tells which way is out; a sharp mask would follow every sulcus.
BLUR_MM = 5.0


def with_strips(septa: Sequence[Septum], brain: Volume, spacing_mm: float, strip_mm: float = STRIP_MM) -> tuple[Septum, ...]:
    """Carry the attached edges of septa out of a brain: see :func:`with_strip`.

    Parameters
    ----------
    septa
        Those without an attached edge stay as they are.
    brain
        Mask or labels, nonzero in the brain.
    spacing_mm, strip_mm
        Longest step between a strip's rows of vertices, and its width.
    """
    if not septa:
        return ()
    blurred = blurred_brain(brain)
    width, spacing = float(mm_to_m(strip_mm)), float(mm_to_m(spacing_mm))
    return tuple(with_strip(s, out_of_brain(blurred, s.surface.vertices[s.attached]), width, spacing) for s in septa)


def with_strip(septum: Septum, outward: NDArray[np.float64], width: float, spacing: float) -> Septum:
    """Continue a sheet past its attached edge.

    Septa that share a vertex of their attached edges, at the torcula, still meet along the strip's end if they are given
    the same direction there.

    Parameters
    ----------
    septum
        One without an attached edge stays as it is.
    outward
        Unit vectors, shape (n, 3), one for each vertex of the attached edge, away from the brain.
    width, spacing
        Of the strip, and the longest step between its rows of vertices, metres.

    Returns
    -------
    Septum
        Its attached edge is the strip's outer one.
    """
    edge, vertices = septum.attached, septum.surface.vertices
    if len(edge) < 2:
        return septum
    rows = int(np.ceil(width / spacing))
    steps = width * np.arange(1, rows + 1) / rows
    added = vertices[edge] + steps[:, None, None] * outward
    ids = np.vstack([edge, len(vertices) + np.arange(rows * len(edge)).reshape(rows, -1)])
    near_one, near_two, far_one, far_two = ids[:-1, :-1], ids[:-1, 1:], ids[1:, :-1], ids[1:, 1:]
    strip = np.stack([near_one, far_one, far_two, near_one, far_two, near_two], axis=-1).reshape(-1, 3)
    if not _has_directed_edge(septum.surface.faces, edge[0], edge[1]):
        strip = strip[:, ::-1]  # neighbouring faces run through their common edge in opposite directions
    faces = np.vstack([septum.surface.faces, strip]).astype(np.int32)
    return Septum(septum.name, Surface(np.vstack([vertices, added.reshape(-1, 3)]), faces), ids[-1].astype(np.int32))


def blurred_brain(brain: Volume) -> Volume:
    """Blur a mask, nonzero in the brain, for :func:`out_of_brain`."""
    sigma = BLUR_MM / np.linalg.norm(m_to_mm(brain.T_patient_voxel[:3, :3]), axis=0)
    mask = (brain.data > 0).astype(np.float32)
    return Volume(ndimage.gaussian_filter(mask, sigma, mode="nearest", truncate=3.0), brain.T_patient_voxel)


def out_of_brain(blurred: Volume, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Find the unit vectors, shape (n, 3), in which a blurred brain mask falls fastest.

    At a cleft between two lobes this is the way out of the cleft, where a sheet carried on straight would enter a lobe.
    """
    offsets = mm_to_m(0.5 * BLUR_MM) * np.vstack([np.eye(3), -np.eye(3)])
    ahead, behind = np.split(sample(blurred, points + offsets[:, None]), 2)
    fall = (behind - ahead).T
    return unit(np.where(np.any(fall, axis=1, keepdims=True), fall, [0.0, 0.0, 1.0]))


def _has_directed_edge(faces: NDArray[np.int32], start: int, end: int) -> bool:
    return bool(np.any((faces == start) & (np.roll(faces, -1, axis=1) == end)))

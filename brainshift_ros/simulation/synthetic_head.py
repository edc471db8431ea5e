"""A whole head around the template's stripped brain: layers as a T1 shows them, drawn from two distances.

The distance from the brain's hull gives cerebrospinal fluid and skull; the depth below the head's outline gives skin and
fat; what lies between is muscle. Face, orbits, air cells and neck are a few ellipsoids: enough for a registration or a
brain extraction to go wrong on, no more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.image.volume import Volume
from brainshift_ros.simulation.synthetic_noise import interpolation_matrix, smooth_noise, tensor_product
from brainshift_ros.units import m_to_mm

#: Brightness on the template's scale, on which white matter is 0.84 and grey 0.66.
AIR, SKIN, FAT, MUSCLE = 0.0, 0.60, 1.05, 0.52
BONE, MARROW = 0.08, 0.55
FLUID, CORD, VITREOUS = 0.25, 0.72, 0.30

_SKIN_MM = 1.8
_CLOSING_MM = 10.0  # sulci and fissures narrower than twice this belong to the hull's inside
_COARSE = 3  # the hull is smooth: every third voxel will do

# Ellipsoids: centre and half axes, mm, template frame.
_SOFT_TISSUE = (
    ((0.0, 44.0, -62.0), (56.0, 50.0, 62.0)),  # face
    ((0.0, 94.0, -58.0), (13.0, 17.0, 20.0)),  # nose
    ((0.0, -2.0, -55.0), (66.0, 72.0, 40.0)),  # around the skull base
    ((0.0, -24.0, -110.0), (58.0, 64.0, 90.0)),  # neck
)
_ORBITS = tuple(((side * 29.0, 57.0, -38.0), (17.0, 26.0, 17.0)) for side in (-1.0, 1.0))
_EYES = tuple(((side * 31.0, 68.0, -38.0), (12.0, 12.0, 12.0)) for side in (-1.0, 1.0))
_AIR_CELLS = (
    ((-27.0, 58.0, -76.0), (12.0, 15.0, 14.0)),  # maxillary sinuses
    ((27.0, 58.0, -76.0), (12.0, 15.0, 14.0)),
    ((0.0, 58.0, -68.0), (8.0, 32.0, 16.0)),  # nasal cavity
    ((0.0, 24.0, -50.0), (10.0, 12.0, 9.0)),  # sphenoid sinus
    ((0.0, 16.0, -96.0), (9.0, 10.0, 34.0)),  # pharynx
)
_CORD_MM, _CANAL_MM, _VERTEBRA_MM = 6.5, 11.0, 19.0


def whole_head(t1: Volume, brain: NDArray[np.bool_], rng: np.random.Generator) -> Volume:
    """Draw skull, scalp, face and neck around a stripped brain.

    Parameters
    ----------
    t1
        The template's, on an axis-aligned grid of 1 mm that has room for the head.
    brain
        Its brain, on the same grid; all else of `t1` is replaced.
    rng
        Source of chance: thicknesses and texture.

    Returns
    -------
    Volume
        The T1 with the head, on the same scale.
    """
    x, y, z = axes_mm = _axes_mm(t1)
    texture, ripple = (smooth_noise(rng, t1.shape, width) for width in (4.0, 9.0))
    hull = _distance_to_hull_mm(brain)
    csf = np.maximum(2.0 + 0.8 * smooth_noise(rng, t1.shape, 30.0), 0.5)
    skull = np.maximum(6.0 + 1.2 * smooth_noise(rng, t1.shape, 35.0), 3.5)
    scalp = np.maximum(6.0 + 1.3 * smooth_noise(rng, t1.shape, 40.0), 3.5)
    outline = hull - (csf + skull + scalp)
    for centre, half_axes in _SOFT_TISSUE:
        outline = _smooth_union(outline, _ellipsoid_mm(axes_mm, centre, half_axes))
    head = (MUSCLE * (1.0 + 0.16 * texture)).astype(np.float32)
    deep = outline < -_SKIN_MM
    head[deep & (outline > -(5.0 + 0.9 * ripple))] = FAT
    head[~deep] = SKIN
    for cells, brightness in ((_ORBITS, FAT), (_EYES, VITREOUS), (_AIR_CELLS, AIR)):
        for centre, half_axes in cells:
            window = _window(axes_mm, centre, half_axes)
            near_mm = (x[window[0]], y[:, window[1]], z[:, :, window[2]])
            inside = _ellipsoid_mm(near_mm, centre, half_axes) + 0.5 * texture[window] < 0.0
            head[window][deep[window] & inside] = brightness
    head[outline >= 0.0] = AIR
    layer = (hull - csf) / skull  # 0 at the inner table, 1 at the outer
    head[(layer > 0.0) & (layer < 1.0)] = BONE
    diploe = np.abs(layer - 0.5) < 0.25
    head[diploe] = MARROW * (1.0 + 0.3 * texture[diploe])
    head[layer <= 0.0] = FLUID
    _draw_spine(head, axes_mm, brain, texture)
    head = np.where(brain & (t1.data > 0.0), t1.data, ndimage.gaussian_filter(head, 0.5))
    return Volume(head.astype(np.float32), t1.T_patient_voxel)


def _draw_spine(
    head: NDArray[np.float32], axes_mm: tuple[NDArray[np.float32], ...], brain: NDArray[np.bool_], texture: NDArray[np.float32]
) -> None:
    """Continue the brainstem's lowest section as a cord in its canal, with vertebrae before it."""
    x, y, z = axes_mm
    lowest = int(np.argmax(brain.any(axis=(0, 1))))
    bottom_mm = float(z[0, 0, lowest])
    centre = [float(axes_mm[k].ravel()[np.nonzero(brain[:, :, lowest])[k]].mean()) for k in (0, 1)]
    below = z < bottom_mm + 4.0
    # The canal leans a little forward on its way down.
    forward = centre[1] - 0.12 * (z - bottom_mm)
    distance = np.sqrt((x - centre[0]) ** 2 + (y - forward) ** 2)
    bodies = np.sqrt((x - centre[0]) ** 2 + (y - forward - _VERTEBRA_MM - 4.0) ** 2)
    spine = below & (z < bottom_mm - 6.0) & (bodies < 13.0)
    head[spine & np.broadcast_to(np.mod(z, 16.0) > 3.0, spine.shape)] = 0.62
    head[spine & (np.abs(bodies - 12.5) < 0.8)] = BONE
    head[below & (np.abs(distance - _CANAL_MM - 2.0) < 2.0)] = BONE
    head[below & (distance < _CANAL_MM)] = FLUID
    cord = below & (distance < _CORD_MM)
    head[cord] = CORD * (1.0 + 0.05 * texture[cord])


def _distance_to_hull_mm(brain: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Signed distance, negative inside, from the brain with its sulci and fissures closed; voxels of 1 mm."""
    sparse = [interpolation_matrix(n, _COARSE) for n in brain.shape]
    index = np.ix_(*[np.rint(nodes).astype(int) for nodes, _ in sparse])
    coarse = brain[index]
    edge = [nodes[1] - nodes[0] for nodes, _ in sparse]
    dilated = ndimage.distance_transform_edt(~coarse, sampling=edge) <= _CLOSING_MM
    closed = ndimage.distance_transform_edt(dilated, sampling=edge) > _CLOSING_MM
    signed = ndimage.distance_transform_edt(~closed, sampling=edge) - ndimage.distance_transform_edt(closed, sampling=edge)
    return tensor_product([matrix for _, matrix in sparse], ndimage.gaussian_filter(signed, 1.0))


def _axes_mm(grid: Volume) -> tuple[NDArray[np.float32], ...]:
    """Coordinates along the axes of an axis-aligned grid, each shaped to broadcast over it."""
    edges, origin = np.diag(grid.T_patient_voxel)[:3], grid.T_patient_voxel[:3, 3]
    axes = [m_to_mm(origin[k] + edges[k] * np.arange(grid.shape[k])).astype(np.float32) for k in range(3)]
    return axes[0][:, None, None], axes[1][None, :, None], axes[2][None, None, :]


def _ellipsoid_mm(
    axes_mm: tuple[NDArray[np.float32], ...], centre: tuple[float, float, float], half_axes: tuple[float, float, float]
) -> NDArray[np.float32]:
    """Distance to an ellipsoid, nearly: exact in sign, and to first order near its surface."""
    scaled = sum(((a - c) / h) ** 2 for a, c, h in zip(axes_mm, centre, half_axes, strict=True))
    gradient = sum(((a - c) / h**2) ** 2 for a, c, h in zip(axes_mm, centre, half_axes, strict=True))
    return ((scaled - 1.0) / (2.0 * np.sqrt(gradient) + 1e-6)).astype(np.float32)


def _window(
    axes_mm: tuple[NDArray[np.float32], ...], centre: tuple[float, float, float], half_axes: tuple[float, float, float]
) -> tuple[slice, ...]:
    """Index box that holds an ellipsoid with a margin for its ragged edge."""
    bounds = [
        np.searchsorted(a.ravel(), (c - h - 3.0, c + h + 3.0)) for a, c, h in zip(axes_mm, centre, half_axes, strict=True)
    ]
    return tuple(slice(int(low), int(high)) for low, high in bounds)


def _smooth_union(a: NDArray[np.float32], b: NDArray[np.float32], width_mm: float = 12.0) -> NDArray[np.float32]:
    """Signed distance of two bodies' union with a fillet (polynomial smooth minimum, Quilez)."""
    h = np.maximum(width_mm - np.abs(a - b), 0.0) / width_mm
    return np.minimum(a, b) - 0.25 * width_mm * h**2

"""The pieces of tumour in a label image: which are meshed, and the surface that the mesh follows around each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.errors import InputError
from brainshift_ros.image.labels import voxel_volume
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import smooth_taubin, surface_of_mask
from brainshift_ros.units import m3_to_ml

#: A piece of tumour below this volume, a ball of 6 mm, is taken as healthy tissue, with a warning.
CRUMB_M3 = 0.1e-6

#: Blur that takes the voxels' steps off: less than at the brain, for a tumour is small and loses more of its shape.
BLUR_M = 0.0007

#: Voxels that share a corner belong to one piece.
_CORNERS = np.ones((3, 3, 3), dtype=bool)


@dataclass(frozen=True)
class TumorPiece:
    """One connected piece of tumour.

    Attributes
    ----------
    surface
        Closed; where the piece reaches the brain's surface it goes on outside, so that the two cross and do not coincide.
    volume
        Of its voxels, m^3.
    """

    surface: Surface
    volume: float


def meshed_tumor(labels: Volume) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """Count the pieces of tumour from 1, the largest first; those below a crumb get 0.

    Returns
    -------
    pieces : ndarray
        Shape of the labels.
    warnings : tuple of str
        What was left out.

    Raises
    ------
    InputError
        There is tumour, but every piece is a crumb.
    """
    numbered, count = ndimage.label(labels.data == Region.TUMOR, structure=_CORNERS)
    if count == 0:
        return numbered.astype(np.int32), ()
    voxels = np.bincount(numbered.ravel(), minlength=count + 1)[1:]
    kept = voxels * voxel_volume(labels) >= CRUMB_M3
    limit = f"{float(m3_to_ml(CRUMB_M3)):g} ml"
    if not kept.any():
        largest = float(m3_to_ml(voxels.max() * voxel_volume(labels)))
        problem = f"the largest piece of tumour holds {largest:.2g} ml, too little to mesh"
        raise InputError("labels", problem, f"draw at least {limit}, or leave the tumour out")
    order = np.argsort(-voxels, kind="stable")
    rank = np.zeros(count + 1, dtype=np.int32)
    rank[1 + order] = np.cumsum(kept[order]) * kept[order]
    warnings: tuple[str, ...] = ()
    if not kept.all():
        lost = float(m3_to_ml(voxels[~kept].sum() * voxel_volume(labels)))
        number = np.count_nonzero(~kept)
        what = "a piece" if number == 1 else f"{number} pieces"
        warnings = (f"{what} of tumour below {limit}, {lost:.2g} ml in all, taken as healthy tissue",)
    return rank[numbered], warnings


def tumor_pieces(pieces: NDArray[np.int32], brain: NDArray[np.bool_], labels: Volume, gap: float) -> tuple[TumorPiece, ...]:
    """Surface and volume of each numbered piece.

    Parameters
    ----------
    pieces
        From :func:`meshed_tumor`.
    brain
        Solid mask on the same grid.
    labels
        Gives the grid.
    gap
        Tissue between tumour and brain surface thinner than this, metres, goes to the tumour: no element would fit in.
    """
    voxel = np.linalg.norm(labels.T_patient_voxel[:3, :3], axis=0)
    gap = max(gap, 1.5 * float(voxel.max()))
    found = []
    for number in range(1, int(pieces.max()) + 1):
        mask, T_patient_voxel = _through_surface(pieces == number, brain, labels.T_patient_voxel, voxel, gap)
        surface = smooth_taubin(surface_of_mask(mask, T_patient_voxel, BLUR_M))
        found.append(TumorPiece(surface, voxel_volume(labels) * np.count_nonzero(pieces == number)))
    return tuple(found)


def _through_surface(
    piece: NDArray[np.bool_],
    brain: NDArray[np.bool_],
    T_patient_voxel: NDArray[np.float64],
    voxel: NDArray[np.float64],
    gap: float,
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Cut a window around a piece; where it comes within `gap` of the brain's surface, let it go through and 2 `gap` on."""
    pad = [int(np.ceil(3.0 * gap / length)) for length in voxel]
    box = ndimage.find_objects(piece.astype(np.uint8))[0]
    window = tuple(slice(axis.start - p, axis.stop + p) for axis, p in zip(box, pad, strict=True))
    solid, inner = (_window(mask, window) for mask in (brain, piece))
    T = T_patient_voxel.copy()
    T[:3, 3] += T[:3, :3] @ [axis.start for axis in window]
    if solid.all():
        return inner, T
    depth = ndimage.distance_transform_edt(solid, voxel)
    lid = solid & (depth + ndimage.distance_transform_edt(~inner, voxel) <= gap)  # on the way out, not beside it
    full = inner | lid
    height, nearest = ndimage.distance_transform_edt(~solid, voxel, return_indices=True)
    return full | (~solid & (height <= 2.0 * gap) & full[tuple(nearest)]), T


def _window(mask: NDArray[np.bool_], window: tuple[slice, ...]) -> NDArray[np.bool_]:
    """Cut a window that may reach beyond the grid; there the mask is false."""
    start = [max(axis.start, 0) for axis in window]
    inside = mask[tuple(slice(first, axis.stop) for first, axis in zip(start, window, strict=True))]
    before = [first - axis.start for first, axis in zip(start, window, strict=True)]
    shape = [axis.stop - axis.start for axis in window]
    after = [size - b - n for size, b, n in zip(shape, before, inside.shape, strict=True)]
    return np.pad(inside, list(zip(before, after, strict=True)))

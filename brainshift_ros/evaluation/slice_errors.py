"""Slices in which two brain masks disagree so much that an eye would see it (thesis, table 7).

The thesis counts slices with "a visually significant misoverlap", judged by eye. Here the judgement is a rule that anyone
can repeat. A slice holds an error if it shows a connected area where the two masks disagree
  - into which a disc of a given diameter fits: a band along the whole contour that is thinner, which is how two careful
    raters differ, is no error however long it is; a lump of dura taken for brain, or a missing gyrus, is one; and
  - which somewhere lies half that diameter or more off the other mask in 3-D: at the poles of the brain, where a slice is
    nearly tangent to its surface, one voxel of disagreement makes a large area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.image.volume import Volume
from brainshift_ros.units import m_to_mm

#: Diameter of the disc: four voxels of a 1 mm image, twice what one voxel of disagreement on either side amounts to.
VISIBLE_MM = 4.0

_AXES = ("sagittal", "coronal", "axial")


@dataclass(frozen=True)
class SliceErrors:
    """How many slices need editing.

    Attributes
    ----------
    orientation
        Of the slices: sagittal, coronal or axial.
    slices
        In the image.
    with_brain
        Slices in which either mask marks something.
    with_errors
        Indices of the slices with errors along the image's axis.
    visible_mm
        Diameter of the disc that must fit.
    thickest_mm
        Diameter of the largest disc that fits into any such area.
    """

    orientation: str
    slices: int
    with_brain: int
    with_errors: tuple[int, ...]
    visible_mm: float
    thickest_mm: float


def slice_errors(automatic: Volume, manual: Volume, axis: int | None = None, visible_mm: float = VISIBLE_MM) -> SliceErrors:
    """Count the slices in which the brain masks of two label images disagree visibly.

    Parameters
    ----------
    automatic, manual
        Label images on one grid; brain is what is not zero.
    axis
        Image axis across the slices; by default the one nearest to the body's long axis, so slices are axial.
    visible_mm
        Diameter of the disc that must fit into a disagreement.
    """
    directions = np.abs(manual.T_patient_voxel[:3, :3] / np.linalg.norm(manual.T_patient_voxel[:3, :3], axis=0))
    axis = int(np.argmax(directions[2])) if axis is None else axis
    a, m = (np.transpose(volume.data > 0, np.roll(range(3), -axis)) for volume in (automatic, manual))
    edges_mm = np.roll(m_to_mm(np.linalg.norm(manual.T_patient_voxel[:3, :3], axis=0)), -axis)
    thickness_mm = np.array([widest_disc_mm(area, edges_mm[1:]) for area in _deep_areas(a, m, edges_mm, 0.5 * visible_mm)])
    return SliceErrors(
        orientation=_AXES[int(np.argmax(directions[:, axis]))],
        slices=len(a),
        with_brain=int(np.count_nonzero((a | m).any(axis=(1, 2)))),
        with_errors=tuple(np.flatnonzero(thickness_mm >= visible_mm).tolist()),
        visible_mm=visible_mm,
        thickest_mm=float(thickness_mm.max(initial=0.0)),
    )


def _deep_areas(
    a: NDArray[np.bool_], m: NDArray[np.bool_], edges_mm: NDArray[np.float64], depth_mm: float
) -> NDArray[np.bool_]:
    """Areas of disagreement, connected within a slice (first axis), that lie at least so deep off the other mask somewhere."""
    box = ndimage.find_objects((a | m).astype(np.uint8))[0]
    ours, theirs = a[box], m[box]
    depth = np.where(theirs, 0.0, ndimage.distance_transform_edt(~theirs, sampling=edges_mm)) * ours
    depth += np.where(ours, 0.0, ndimage.distance_transform_edt(~ours, sampling=edges_mm)) * theirs
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[1, 1, :] = in_slice[1, :, 1] = True
    areas, count = ndimage.label(ours != theirs, in_slice)
    deepest = ndimage.maximum(depth, areas, np.arange(count + 1))
    deep = np.zeros(a.shape, dtype=bool)
    deep[box] = (deepest >= depth_mm)[areas] & (areas > 0)
    return deep


def widest_disc_mm(mask: NDArray[np.bool_], edges_mm: NDArray[np.float64]) -> float:
    """Diameter of the largest disc inside a mask, shape (m, n), to about a pixel; 0 for an empty one.

    A band w pixels wide has pixels whose centres are up to (w + 1) / 2 pixels from the centre of one outside.
    """
    if not mask.any():
        return 0.0
    box = ndimage.find_objects(mask.astype(np.uint8))[0]
    depth_mm = ndimage.distance_transform_edt(np.pad(mask[box], 1), sampling=edges_mm).max()
    return float(2.0 * depth_mm - edges_mm.min())

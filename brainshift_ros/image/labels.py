"""What a label image and a tumour mask must satisfy, and the brain they describe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.image.resample import resample, sample
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.units import m_to_mm

#: Labels stored as floats, or through a header's scale factor, may miss their integer by this much.
ROUNDING = 1e-3


def labels_on_grid(labels: Volume, t1: Volume, source: object = "label image") -> Volume:
    """Check a label image and bring it onto the grid of the T1 (nearest neighbour).

    Parameters
    ----------
    labels
        Values of :class:`Region`, on any grid.
    t1
        The MR.
    source
        What errors name.

    Raises
    ------
    InputError
        Values other than 0 to 5, no brain at all, or a brain that lies outside the T1.
    """
    values = np.unique(labels.data)
    allowed = [int(region) for region in Region]
    whole = np.rint(values)
    strange = values[(np.abs(values - whole) > ROUNDING) | ~np.isin(whole, allowed)]
    if strange.size:
        problem = f"holds values other than 0 to {max(allowed)}: {', '.join(f'{v:g}' for v in strange[:5].astype(float))}"
        meaning = ", ".join(f"{int(r)} {r.name.lower().replace('_', ' ')}" for r in Region)
        raise InputError(source, problem, f"use {meaning}")
    if not whole.any():
        raise InputError(source, "labels no voxel", "label the brain")
    integral = Volume(np.rint(labels.data).astype(np.uint8), labels.T_patient_voxel)
    on_grid = resample(integral, t1, "nearest")
    expected = np.count_nonzero(integral.data) * voxel_volume(integral)
    covered = np.count_nonzero(on_grid.data) * voxel_volume(on_grid)
    seen = np.count_nonzero((on_grid.data > 0) & (t1.data != 0)) * voxel_volume(t1)
    if covered < 0.5 * expected or seen < 0.5 * expected:
        problem = f"only {100 * min(covered, seen) / expected:.0f} % of its brain lies on the head of the T1"
        raise InputError(source, problem, "give labels of the same patient, in the frame of the T1")
    return on_grid


def add_tumor(labels: Volume, tumor: Volume, source: object = "tumour mask") -> Volume:
    """Write a tumour mask, on any grid and of any number of pieces, into a label image; tumour that is there stays.

    Raises
    ------
    InputError
        The mask is empty, falls between the voxels of the labels, or less than nine tenths of it lie in the labelled brain.
    """
    inside = Volume((tumor.data > 0).astype(np.uint8), tumor.T_patient_voxel)
    if not inside.data.any():
        raise InputError(source, "marks no voxel", "draw the tumour, or leave the mask out")
    # Counted where the mask was drawn: on the grid of the labels, a small tumour's volume would depend on how voxels fall.
    centres = transform_points(inside.T_patient_voxel, np.argwhere(inside.data))
    within = float(np.mean(sample(labels, centres, "nearest") > 0))
    if within < 0.9:
        raise InputError(source, f"only {100 * within:.0f} % of it lies in the brain", "check its frame against the labels")
    on_grid = resample(inside, labels, "nearest").data > 0
    if not np.any(on_grid & (labels.data > 0)):
        problem = f"marks {len(centres)} voxel(s), so little that none of the label image's voxels lies in it"
        raise InputError(source, problem, "draw the whole tumour, or leave the mask out")
    return Volume(np.where(on_grid & (labels.data > 0), np.uint8(Region.TUMOR), labels.data), labels.T_patient_voxel)


#: Area of brain on a face of the image above which the image is said to cut it.
EDGE_AREA_MM2 = 100.0

_SIDES = (("left", "right"), ("posterior", "anterior"), ("inferior", "superior"))


def edge_warnings(labels: Volume) -> tuple[str, ...]:
    """Say where the image ends inside the brain, for what lies beyond is not in the model.

    The brainstem does not count: it goes on into the spinal cord, and some edge has to cut it.
    """
    brain = (labels.data > 0) & (labels.data != Region.BRAINSTEM)
    axes_mm = m_to_mm(labels.T_patient_voxel[:3, :3])
    warnings = []
    for axis in range(3):
        across = np.cross(*np.delete(axes_mm, axis, axis=1).T)
        direction = axes_mm[:, axis] / np.linalg.norm(axes_mm[:, axis])
        along = int(np.argmax(np.abs(direction)))
        for end in (0, -1):
            area_mm2 = float(np.linalg.norm(across)) * np.count_nonzero(np.take(brain, end, axis=axis))
            if area_mm2 > EDGE_AREA_MM2:
                side = _SIDES[along][int((direction[along] > 0) == (end == -1))]
                warnings.append(
                    f"the image's {side} edge cuts the brain over {area_mm2 / 100:.1f} cm^2; what lies beyond is missing"
                )
    return tuple(warnings)


def voxel_volume(volume: Volume) -> float:
    """Volume of one voxel, m^3."""
    return float(abs(np.linalg.det(volume.T_patient_voxel[:3, :3])))


def largest_component(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep the largest face-connected part of a mask."""
    parts, count = ndimage.label(mask)
    if count <= 1:
        return mask
    return parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])


def cropped(volume: Volume, mask: NDArray[np.bool_], margin: int) -> Volume:
    """Cut a volume to the bounding box of a mask on its grid, `margin` voxels wider where the grid allows."""
    box = ndimage.find_objects(mask.astype(np.uint8))[0]
    start = [max(axis.start - margin, 0) for axis in box]
    window = tuple(slice(first, axis.stop + margin) for first, axis in zip(start, box, strict=True))
    T_patient_voxel = volume.T_patient_voxel.copy()
    T_patient_voxel[:3, 3] += T_patient_voxel[:3, :3] @ start
    return Volume(volume.data[window], T_patient_voxel)

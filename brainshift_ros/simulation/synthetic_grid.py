"""Store the same image otherwise: flipped or permuted axes, oblique, thick slices, cut by the field of view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import transform_points
from brainshift_ros.image.resample import resample
from brainshift_ros.image.volume import Volume


def reoriented(volume: Volume, order: Sequence[int] = (0, 1, 2), signs: Sequence[int] = (1, 1, 1)) -> Volume:
    """Permute and flip the stored axes; every value stays where it is in the patient.

    Parameters
    ----------
    volume
        The image.
    order
        New axis k is old axis ``order[k]``.
    signs
        -1 turns new axis k round. ``signs=(-1, 1, 1)`` alone stores left and right the other way.
    """
    data = np.transpose(volume.data, order)
    T_old_new = np.zeros((4, 4))
    T_old_new[3, 3] = 1.0
    for new, (old, sign) in enumerate(zip(order, signs, strict=True)):
        T_old_new[old, new] = sign
        if sign < 0:
            data = np.flip(data, axis=new)
            T_old_new[old, 3] = data.shape[new] - 1
    return Volume(np.ascontiguousarray(data), volume.T_patient_voxel @ T_old_new)


def oblique(volume: Volume, turn: Rotation, labels: bool = False) -> Volume:
    """Resample on a grid turned about the image's centre and large enough to hold it all.

    Parameters
    ----------
    volume
        The image.
    turn
        How the new axes are turned against the old, in the patient frame.
    labels
        Take the nearest value instead of the linear mean.
    """
    edges = np.linalg.norm(volume.T_patient_voxel[:3, :3], axis=0)
    corners = transform_points(volume.T_patient_voxel, _corners(volume.shape))
    centre = corners.mean(axis=0)
    axes = turn.as_matrix() @ (volume.T_patient_voxel[:3, :3] / edges)
    half = np.abs((corners - centre) @ axes).max(axis=0)
    shape = np.ceil(2.0 * half / edges).astype(int) + 1
    T_patient_voxel = np.eye(4)
    T_patient_voxel[:3, :3] = axes * edges
    T_patient_voxel[:3, 3] = centre - T_patient_voxel[:3, :3] @ (0.5 * (shape - 1))
    grid = Volume(np.broadcast_to(np.uint8(0), tuple(shape)), T_patient_voxel)
    return resample(volume, grid, "nearest" if labels else "linear")


def thick_slices(volume: Volume, slices: int, axis: int = 2, labels: bool = False) -> Volume:
    """Join so many slices into one along an axis: the mean, as a scanner's slice has; for labels what lies at its middle."""
    count = volume.shape[axis] // slices
    data = np.moveaxis(volume.data, axis, 0)[: count * slices]
    mean = np.moveaxis(data.reshape(count, slices, *data.shape[1:]).mean(axis=1), 0, axis)
    T_fine_thick = np.eye(4)
    T_fine_thick[axis, axis] = slices
    T_fine_thick[axis, 3] = 0.5 * (slices - 1)
    thick = Volume(np.ascontiguousarray(mean), volume.T_patient_voxel @ T_fine_thick)
    return resample(volume, thick, "nearest") if labels else thick


def cut_off(volume: Volume, fraction: float, axis: int = 2, side: int = 1) -> Volume:
    """Leave out a fraction of the slices at one end of an axis: a field of view that is too small.

    `side` is 1 for the end with the highest index, -1 for the other.
    """
    gone = round(fraction * volume.shape[axis])
    window = [slice(None)] * 3
    window[axis] = slice(gone, None) if side < 0 else slice(None, volume.shape[axis] - gone)
    start = np.array([part.start or 0 for part in window], dtype=np.float64)
    T_patient_voxel = volume.T_patient_voxel.copy()
    T_patient_voxel[:3, 3] += T_patient_voxel[:3, :3] @ start
    return Volume(np.ascontiguousarray(volume.data[tuple(window)]), T_patient_voxel)


def _corners(shape: tuple[int, int, int]) -> NDArray[np.float64]:
    ends = [(0.0, n - 1.0) for n in shape]
    return np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)

"""A patient whose truth is known: the MNI152 template, deformed, imaged otherwise, and given a tumour.

What a registration of the template to this image finds can be checked everywhere, which no real patient allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import rigid, transform_points, unit
from brainshift_ros.image.template import template_labels, template_landmarks, template_t1
from brainshift_ros.image.tumor import TumorShape
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.septa.sheets import Septum, septa_from_landmarks
from brainshift_ros.simulation.synthetic_carry import carried
from brainshift_ros.simulation.synthetic_head import whole_head as draw_head
from brainshift_ros.simulation.synthetic_mr import imaged, random_contrast, with_tumor
from brainshift_ros.simulation.synthetic_warp import SyntheticWarp, random_warp
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm, mm_to_m

#: Voxels of 1 mm added to the template's grid at the low and the high end of each axis, for the head and the warp.
_ROOM_MM = ((10, 10), (16, 32), (60, 8))

#: A stripped brain needs less room.
_STRIPPED_ROOM_MM = ((0, 0), (0, 0), (20, 0))


@dataclass(frozen=True)
class SyntheticPatient:
    """An MR with everything that is true of it.

    Attributes
    ----------
    t1
        float32; white matter about 700.
    labels
        uint8, values of :class:`Region`, on the grid of the T1, the tumour included.
    tumor
        Mask on the same grid, or None.
    warp
        The true template-to-patient map, with the figures of its displacement.
    septa
        The template's falx, left and right tentorium, mapped.
    grey_white_ratio
        Of the brain's intensities before bias and noise; the template's is 0.79.
    whole_head
        Whether the image shows more than the brain.
    """

    t1: Volume
    labels: Volume
    tumor: Volume | None
    warp: SyntheticWarp
    septa: tuple[Septum, ...]
    grey_white_ratio: float
    whole_head: bool

    def to_patient(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points of the template, shape (n, 3) in metres, to the patient; the tumour displaces nothing."""
        return self.warp.to_patient(points)

    def to_template(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse of :meth:`to_patient`."""
        return self.warp.to_template(points)


def synthetic_patient(
    seed: int,
    *,
    whole_head: bool = False,
    tumor: TumorShape | None = None,
    mean_displacement_mm: float = 6.0,
    noise: float = 0.03,
    bias: float = 0.2,
    spacing_mm: float | Sequence[float] = 1.0,
    tilt_deg: float = 6.0,
    offset_mm: float = 8.0,
    septa_spacing_mm: float = 3.0,
) -> SyntheticPatient:
    """Deform the template at random, and image it as another scanner would.

    Parameters
    ----------
    seed
        The same seed gives the same patient.
    whole_head
        Draw skull, scalp, face and neck around the brain; otherwise all outside the brain is zero.
    tumor
        Drawn after the deformation, so it has no counterpart in the template and displaces nothing. Its centre is a place in
        the template; where the deformation leaves too little room, it is moved inward.
    mean_displacement_mm
        Mean length over the brain of the non-rigid displacement.
    noise
        Standard deviation of the Rician noise's two parts, as a fraction of white matter.
    bias
        Largest logarithm of the smooth multiplicative bias field within the head; 0.2 is a range of 0.82 to 1.22.
    spacing_mm
        Voxel edges along x, y, z. Voxels thicker than 2 mm hold the mean over their thickness.
    tilt_deg, offset_mm
        Rotation about a random axis through the image's origin, and length of the random translation, that follow.
    septa_spacing_mm
        Between the vertices of the true septa.

    Raises
    ------
    InputError
        The displacement folds the brain, or the tumour does not lie in it.
    """
    rng = np.random.default_rng(seed)
    template = _template(whole_head)
    brain = template.labels.data > 0
    some = np.argwhere(brain)[:: max(1, np.count_nonzero(brain) // 2000)]
    brain_mm = m_to_mm(transform_points(template.labels.T_patient_voxel, some))
    turn = Rotation.from_rotvec(np.deg2rad(tilt_deg) * unit(rng.normal(size=3)))
    T_patient_warped = rigid(turn, mm_to_m(offset_mm) * unit(rng.normal(size=3)))
    warp = random_warp(rng, brain_mm, mean_displacement_mm, T_patient_warped)
    source = draw_head(template.t1, brain, rng) if whole_head else template.t1
    t1, labels = carried(source, template.labels, warp, spacing_mm)
    contrast = random_contrast(rng)
    t1, marked = contrast(t1), None
    if tumor is not None:
        centre_mm = m_to_mm(warp.to_patient(mm_to_m([tumor.center_mm])))[0]
        t1, labels = with_tumor(t1, labels, replace(tumor, center_mm=tuple(centre_mm.tolist())))
        marked = Volume(labels.data == Region.TUMOR, labels.T_patient_voxel)
    t1 = imaged(t1, noise, bias, rng)
    if not whole_head:
        t1 = Volume(np.where(labels.data > 0, t1.data, np.float32(0.0)), t1.T_patient_voxel)
    septa = septa_from_landmarks(template_landmarks().septa, septa_spacing_mm)
    moved = tuple(replace(s, surface=Surface(warp.to_patient(s.surface.vertices), s.surface.faces)) for s in septa)
    return SyntheticPatient(t1, labels, marked, warp, moved, contrast.grey_white_ratio, whole_head)


@dataclass(frozen=True)
class _Template:
    t1: Volume
    labels: Volume


@lru_cache
def _template(whole_head: bool) -> _Template:
    room = _ROOM_MM if whole_head else _STRIPPED_ROOM_MM
    t1, labels = _padded(template_t1(), room), _padded(template_labels(template_landmarks()), room)
    return _Template(t1 if whole_head else _continued(t1), labels)


def _continued(t1: Volume) -> Volume:
    """Continue a stripped image a little beyond its edge, by the mean of what is near.

    Else interpolation would darken the outermost voxels of the deformed brain, which stripping by a mask does not do.
    """
    brain = (t1.data > 0.0).astype(np.float32)
    near = ndimage.uniform_filter(brain, 5)
    mean = ndimage.uniform_filter(t1.data, 5) / np.maximum(near, 1e-3)
    return Volume(np.where((brain == 0.0) & (near > 1e-3), mean, t1.data), t1.T_patient_voxel)


def _padded(volume: Volume, room: tuple[tuple[int, int], ...]) -> Volume:
    T_patient_voxel = volume.T_patient_voxel.copy()
    T_patient_voxel[:3, 3] -= T_patient_voxel[:3, :3] @ [low for low, _ in room]
    return Volume(np.pad(volume.data, room), T_patient_voxel)

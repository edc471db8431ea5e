"""The images that are registered: template and patient on axis-parallel grids of one voxel size, and what counts of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.image.grid import Grid
from brainshift_ros.image.resample import resample
from brainshift_ros.image.volume import Volume
from brainshift_ros.units import mm_to_m

#: Room around the template's brain in which the displacement may still change.
_TEMPLATE_MARGIN_MM = 20.0
#: Beyond this quantile of the positive voxels, intensities are clipped: fat and vessels would fill the histogram.
_CLIP_QUANTILE = 0.995


@dataclass(frozen=True)
class WorkingImages:
    """What one registration compares.

    Attributes
    ----------
    fixed, fixed_mask
        The template's T1, and 1 up to the margin around its brain.
    moving
        The patient's T1.
    known
        1 inside the patient's image and outside the tumour: what has no counterpart does not count.
    healthy
        1 outside the tumour. What lies beyond the image counts as background, so that no transform gains by moving the
        brain out of sight.
    """

    fixed: Volume
    fixed_mask: Volume
    moving: Volume
    known: Volume
    healthy: Volume


def working_images(
    template: Volume, brain: NDArray[np.bool_], t1: Volume, tumor: Volume | None, spacing_mm: float, margin_mm: float
) -> WorkingImages:
    """Bring template and patient to the resolution of the registration.

    Parameters
    ----------
    template, brain
        The template's T1 and its brain mask, shape of its data.
    t1, tumor
        The patient's image, and a mask on any grid.
    spacing_mm
        Edge of the cubic voxels.
    margin_mm
        Width of the shell around the brain that counts.
    """
    spacing = float(mm_to_m(spacing_mm))
    brain_points = Grid.of(template).centres(np.argwhere(brain))
    box = Grid.around(brain_points, spacing, float(mm_to_m(_TEMPLATE_MARGIN_MM)))
    outside = _on(box, Volume(brain.astype(np.float32), template.T_patient_voxel)).data < 0.5
    near = ndimage.distance_transform_edt(outside) * spacing_mm <= margin_mm

    corners = Grid.of(t1).centres(np.argwhere(np.ones((2, 2, 2))) * (np.array(t1.shape) - 1))
    around = Grid.around(corners, spacing, 2.0 * spacing)
    ceiling = np.quantile(t1.data[t1.data > 0], _CLIP_QUANTILE)
    moving = _on(around, Volume(np.clip(t1.data / ceiling, 0.0, 1.0).astype(np.float32), t1.T_patient_voxel))
    inside = resample(Volume(np.ones(t1.shape, dtype=np.uint8), t1.T_patient_voxel), moving, "nearest").data > 0
    healthy = np.ones(around.shape, dtype=bool)
    if tumor is not None:
        marked = Volume((tumor.data > 0).astype(np.float32), tumor.T_patient_voxel)
        # A voxel wider: its rim enhances or swells.
        healthy = ~ndimage.binary_dilation(_on(around, marked).data > 0.1)

    def mask(grid: Grid, data: NDArray[np.bool_]) -> Volume:
        return Volume(data.astype(np.uint8), grid.T_patient_voxel)

    return WorkingImages(_on(box, template), mask(box, near), moving, mask(around, inside & healthy), mask(around, healthy))


def _on(grid: Grid, volume: Volume) -> Volume:
    """Sample on a coarser or finer grid; what the coarser grid cannot hold is smoothed away first."""
    spacing = grid.voxel_edges.min()
    # Gaussian whose width adds up, in squares, with the given voxel's to the wanted voxel's (Cardoso et al. 2015).
    ratio = spacing / np.linalg.norm(volume.T_patient_voxel[:3, :3], axis=0)
    sigma = np.sqrt(np.maximum(ratio**2 - 1.0, 0.0) / (8.0 * np.log(2.0)))
    smooth = Volume(ndimage.gaussian_filter(volume.data.astype(np.float32), sigma), volume.T_patient_voxel)
    target = Volume(np.broadcast_to(np.uint8(0), grid.shape), grid.T_patient_voxel)
    return resample(smooth, target, "linear")

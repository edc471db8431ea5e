"""Labels of a patient T1 from the template's, by registration."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import transform_points
from brainshift_ros.image.grid import Grid, reached
from brainshift_ros.image.labels import add_tumor
from brainshift_ros.image.template import template_labels, template_landmarks, template_t1
from brainshift_ros.image.volume import Volume
from brainshift_ros.segmentation.checks import check_linear, check_map
from brainshift_ros.segmentation.likeness import likeness
from brainshift_ros.segmentation.register import register_linear, register_nonrigid
from brainshift_ros.segmentation.settings import SegmentationSettings
from brainshift_ros.segmentation.template_map import TemplateMap
from brainshift_ros.segmentation.working_images import WorkingImages, working_images

#: The one stage that `progress` hears of.
STAGE = "segmentation"

#: Voxels of the rigid and affine registration: fine enough to tell brain from scalp, coarse enough for a second a start.
_LINEAR_SPACING_MM = 4.0


@dataclass(frozen=True)
class Segmentation:
    """What the template says about a patient.

    Attributes
    ----------
    labels
        uint8, values of :class:`~brainshift_ros.image.volume.Region`, on the T1's grid; with the tumour where one is given.
    template_map
        The transform that carried them, for septa and other points.
    warnings
        What a person should look at.
    diagnostics
        Figures of the registration, by name; times in seconds among them.
    """

    labels: Volume
    template_map: TemplateMap
    warnings: tuple[str, ...]
    diagnostics: Mapping[str, float]


def segment(
    t1: Volume,
    *,
    tumor: Volume | None = None,
    settings: SegmentationSettings | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Segmentation:
    """Label brain, cerebellum and brainstem of a T1 image of a whole head or of a stripped brain.

    Parameters
    ----------
    t1
        Any grid. Its affine says where left and right are; a mirrored image cannot be told from a head, which is
        nearly symmetric.
    tumor
        Mask on any grid: left out of the registration, written into the labels.
    settings
        Resolution and effort.
    progress
        Called with the stage's name and the fraction done.

    Raises
    ------
    InputError
        The registration failed, or its result cannot be a head.
    """
    begin = time.monotonic()
    settings = SegmentationSettings() if settings is None else settings

    def report(fraction: float) -> None:
        if progress is not None:
            progress(STAGE, fraction)

    template, regions = template_t1(), template_labels(template_landmarks())

    def images(spacing_mm: float) -> WorkingImages:
        return working_images(template, regions.data > 0, t1, tumor, spacing_mm, settings.margin_mm)

    coarse = images(max(_LINEAR_SPACING_MM, settings.spacing_mm))
    linear = register_linear(coarse, settings, lambda seconds: report(0.05 + 0.15 * seconds / (seconds + 3.0)))
    alike = likeness(coarse, partial(transform_points, linear.T_affine))
    warnings = check_linear(linear, alike)
    fine = images(settings.spacing_mm)
    found = register_nonrigid(fine, linear, settings, lambda seconds: report(0.2 + 0.7 * seconds / (seconds + 15.0)))
    warnings += check_map(found.template_map)
    labels = carried(regions, found.template_map, t1)
    if tumor is not None:
        labels = add_tumor(labels, tumor)
    report(1.0)
    diagnostics = {
        "brain inside the image": alike.seen,
        "correlation ratio, affine": alike.correlation_ratio,
        "correlation ratio": likeness(fine, found.template_map.to_patient).correlation_ratio,
        **{f"{stage}, s": seconds for stage, seconds in linear.times_s.items()},
        "non-rigid, s": found.time_s,
        "segmentation, s": time.monotonic() - begin,
        "registration, CPU s": linear.cpu_s + found.cpu_s,
        "registration, GB": found.peak_bytes / 2**30,
    }
    return Segmentation(labels, found.template_map, warnings, diagnostics)


def carried(template_regions: Volume, template_map: TemplateMap, t1: Volume) -> Volume:
    """Carry the template's labels to the grid of a patient image: each voxel takes the label at its template point."""
    grid = Grid.of(t1)
    data = np.zeros(t1.shape, dtype=np.uint8)
    for i in range(t1.shape[0]):
        data[i] = _slab(template_regions, template_map, grid, i)
    return Volume(data, t1.T_patient_voxel)


def _slab(template_regions: Volume, template_map: TemplateMap, grid: Grid, i: int) -> NDArray[np.uint8]:
    """Labels of one slice, shape (J, K); slice by slice, a large image needs little memory."""
    _, J, K = grid.shape
    indices = np.stack(np.broadcast_arrays(i, *np.mgrid[:J, :K]), axis=-1).reshape(-1, 3)
    points = grid.centres(indices)
    field = template_map.grid
    # Only what the affine part brings near the brain is worth the inverse.
    near = np.flatnonzero(
        reached(field.to_voxels(transform_points(np.linalg.inv(template_map.T_affine), points)), field.shape, 0)
    )
    voxels = np.rint(Grid.of(template_regions).to_voxels(template_map.to_template_from_table(points[near]))).astype(np.intp)
    within = reached(voxels.astype(np.float64), template_regions.shape, 0)
    labels = np.zeros(J * K, dtype=np.uint8)
    labels[near[within]] = template_regions.data[tuple(voxels[within].T)]
    return labels.reshape(J, K)

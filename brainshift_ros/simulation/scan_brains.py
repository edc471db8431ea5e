"""Brains to scan: the MNI152 cortex warped at random, and the same cortex as a patient's model would have it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage

from brainshift_ros.image.labels import largest_component
from brainshift_ros.image.template import template_t1
from brainshift_ros.simulation.truth import smooth_random_field
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import surface_of_mask, vertex_normals

#: Standard deviation of the smooth error of a patient's model along the normals, metres.
SEGMENTATION_ERROR_M = 0.25e-3

_WARP_LENGTH_M, _WARP_M, _SCALE = 35e-3, 3.5e-3, 0.06
_SEGMENTATION_LENGTH_M = 7e-3


@lru_cache(maxsize=2)
def _template_cortex(threshold: float, blur_m: float) -> Surface:
    """Surface of the tissue of the MNI brain that is brighter on its T1 than `threshold`, sulci open."""
    t1 = template_t1()
    tissue = ndimage.binary_fill_holes(largest_component(t1.data > threshold))
    return surface_of_mask(tissue, t1.T_patient_voxel, blur_m)


@lru_cache(maxsize=4)
def brain(number: int, segmentation_error_m: float = SEGMENTATION_ERROR_M) -> tuple[Surface, Surface]:
    """Make the brain of a number: the cortex as it is, and as the patient's model has it.

    The model's is another isosurface, more smoothed, with a smooth error along its normals.
    """
    surfaces = []
    for threshold, blur_m, error_m in ((0.42, 0.7e-3, 0.0), (0.47, 1.0e-3, segmentation_error_m)):
        surface = _template_cortex(threshold, blur_m)
        rng = np.random.default_rng([number, 7])
        warp = [smooth_random_field(surface.vertices, _WARP_LENGTH_M, rng, modes=24) for _ in range(3)]
        scale = 1.0 + rng.uniform(-_SCALE, _SCALE, 3)
        vertices = scale * surface.vertices + _WARP_M * np.stack(warp, axis=-1)
        if error_m > 0:
            wrong = smooth_random_field(vertices, _SEGMENTATION_LENGTH_M, rng, modes=128)
            vertices = vertices + error_m * wrong[:, None] * vertex_normals(vertices, surface.faces)
        surfaces.append(Surface(vertices, surface.faces))
    return surfaces[0], surfaces[1]

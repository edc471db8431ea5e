"""Draw a tumour into a healthy image, for the demo and for studies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points, unit
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.units import m_to_mm


@dataclass(frozen=True)
class TumorShape:
    """A roundish tumour with a bright rim around a dark core, as after gadolinium.

    Attributes
    ----------
    center_mm
        Patient frame, RAS.
    diameter_mm
        Of the sphere of equal volume, nearly.
    irregularity
        Standard deviation of the radius over directions, as a fraction of the radius.
    rim_mm
        Thickness of the bright rim.
    rim_intensity, core_intensity
        As multiples of the white matter's intensity.
    seed
        Of the shape.
    """

    center_mm: tuple[float, float, float] = (-28.0, 34.0, 23.0)
    diameter_mm: float = 30.0
    irregularity: float = 0.06
    rim_mm: float = 3.0
    rim_intensity: float = 1.12
    core_intensity: float = 0.62
    seed: int = 7


def draw_tumor(t1: Volume, labels: Volume, shape: TumorShape | None = None) -> tuple[Volume, Volume]:
    """Draw a tumour into an MR and its labels.

    Parameters
    ----------
    t1, labels
        On the same grid.
    shape
        Where and what; by default a 3 cm tumour in the left frontal lobe of the MNI152 template.

    Returns
    -------
    t1, labels : Volume
        New volumes; inputs stay as they are.

    Raises
    ------
    InputError
        The tumour does not lie wholly inside the labelled brain.
    """
    shape = shape or TumorShape()
    depth_mm = _depth_mm(labels, shape)
    inside = depth_mm > 0.0
    if not inside.any() or np.any(labels.data[inside] == Region.OUTSIDE):
        problem = f"a tumour of {shape.diameter_mm:g} mm at {shape.center_mm} mm does not lie wholly inside the brain"
        raise InputError("tumour shape", problem, "move it deeper or make it smaller")
    label_data = labels.data.copy()
    label_data[inside] = Region.TUMOR
    brain = t1.data[(labels.data > 0) & (t1.data > 0)]
    white = float(np.percentile(brain, 85))
    texture = ndimage.gaussian_filter(np.random.default_rng(shape.seed).normal(size=t1.shape), 1.5)
    # rim: a smooth shell that is brightest rim_mm / 2 below the tumour's surface
    rim = np.exp(-0.5 * ((depth_mm - 0.5 * shape.rim_mm) / (0.4 * shape.rim_mm)) ** 2)
    tumor = white * (shape.core_intensity + (shape.rim_intensity - shape.core_intensity) * rim + 0.15 * texture)
    blend = np.clip(depth_mm + 0.5, 0.0, 1.0)  # partial volume of the outermost voxel
    return Volume((t1.data * (1.0 - blend) + tumor * blend).astype(t1.data.dtype), t1.T_patient_voxel), Volume(
        label_data, labels.T_patient_voxel
    )


def _depth_mm(grid: Volume, shape: TumorShape) -> NDArray[np.float64]:
    """Depth below the tumour's surface along the ray from its centre, mm; negative outside."""
    points_mm = m_to_mm(transform_points(grid.T_patient_voxel, np.moveaxis(np.indices(grid.shape), 0, -1)))
    offset = points_mm - np.asarray(shape.center_mm)
    distance = np.linalg.norm(offset, axis=-1)
    near = distance < shape.diameter_mm
    radius = np.full(grid.shape, 0.5 * shape.diameter_mm)
    direction = offset[near] / np.maximum(distance[near], 1e-9)[:, None]
    radius[near] *= 1.0 + shape.irregularity * _smooth_noise(direction, shape.seed)
    return np.where(near, radius - distance, -distance)


def _smooth_noise(direction: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Smooth function of unit vectors (n, 3), mean about 0 and standard deviation about 1: a sum of a few plane waves."""
    rng = np.random.default_rng(seed)
    waves = unit(rng.normal(size=(8, 3))) * rng.uniform(2.0, 4.0, size=(8, 1))
    return np.sqrt(2.0 / 8.0) * np.cos(direction @ waves.T + rng.uniform(0.0, 2.0 * np.pi, 8)).sum(axis=1)

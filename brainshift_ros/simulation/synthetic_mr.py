"""What a scanner does to a head: contrast, coil sensitivity, noise, slice thickness."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points, unit
from brainshift_ros.image.labels import cropped
from brainshift_ros.image.tumor import TumorShape, draw_tumor
from brainshift_ros.image.volume import Volume
from brainshift_ros.simulation.synthetic_noise import smooth_noise
from brainshift_ros.units import m_to_mm

#: Modes of grey and white matter on the template's scale.
TEMPLATE_GREY, TEMPLATE_WHITE = 0.66, 0.84

#: How far a tumour may be moved towards the brain's middle; the deformation may leave too little room where it was.
_INWARD_MM = 10

#: Brightness that white matter gets.
WHITE = 700.0


@dataclass(frozen=True)
class Contrast:
    """A monotone change of brightness, I -> WHITE (I / white)^exponent: another ratio of grey to white."""

    exponent: float

    @property
    def grey_white_ratio(self) -> float:
        """Brightness of grey matter over that of white; the template's is 0.79."""
        return float((TEMPLATE_GREY / TEMPLATE_WHITE) ** self.exponent)

    def __call__(self, t1: Volume) -> Volume:
        """Apply to an image on the template's scale."""
        bright = WHITE * np.power(np.maximum(t1.data, 0.0) / TEMPLATE_WHITE, self.exponent)
        return Volume(bright.astype(np.float32), t1.T_patient_voxel)


def random_contrast(rng: np.random.Generator) -> Contrast:
    """Draw a contrast from that of a flat to that of a steep T1: grey over white 0.72 to 0.60."""
    return Contrast(float(rng.uniform(1.35, 2.1)))


def imaged(t1: Volume, noise: float, bias: float, rng: np.random.Generator) -> Volume:
    """Multiply by a smooth bias field and add Rician noise; what is exactly zero stays so in a stripped image.

    Parameters
    ----------
    t1
        Noise-free, white matter `WHITE`.
    noise
        Standard deviation of the complex signal's two parts, as a fraction of `WHITE` (Gudbjartsson and Patz 1995).
    bias
        Largest absolute logarithm of the bias field within the head.
    """
    head = t1.data > 0.02 * WHITE
    edge_mm = float(m_to_mm(np.linalg.norm(t1.T_patient_voxel[:3, :3], axis=0).max()))
    field = smooth_noise(rng, t1.shape, 60.0 / edge_mm)
    bright = t1.data * np.exp(bias * field / np.abs(field[head]).max())
    if noise > 0.0:
        real, imaginary = noise * WHITE * rng.standard_normal((2, *t1.shape), dtype=np.float32)
        bright = np.hypot(bright + real, imaginary)
    return Volume(bright.astype(np.float32), t1.T_patient_voxel)


def with_tumor(t1: Volume, labels: Volume, shape: TumorShape) -> tuple[Volume, Volume]:
    """Draw a tumour as :func:`brainshift_ros.image.tumor.draw_tumor` does, moved inward until it lies wholly in the brain.

    Raises
    ------
    InputError
        It does not even after `_INWARD_MM`.
    """
    brain = labels.data > 0
    # Drawn inside the brain's box only, which is faster.
    small_t1, small_labels = cropped(t1, brain, 2), cropped(labels, brain, 2)
    middle_mm = m_to_mm(transform_points(labels.T_patient_voxel, np.argwhere(brain).mean(axis=0)))
    inward = unit(middle_mm - shape.center_mm)
    for depth_mm in range(0, _INWARD_MM + 1, 2):
        place = tuple((shape.center_mm + depth_mm * inward).tolist())
        try:
            small_t1, small_labels = draw_tumor(small_t1, small_labels, replace(shape, center_mm=place))
            break
        except InputError:
            if depth_mm == _INWARD_MM:
                raise
    start = np.maximum([np.flatnonzero(brain.any(axis=axes))[0] - 2 for axes in ((1, 2), (0, 2), (0, 1))], 0)
    window = tuple(slice(first, first + n) for first, n in zip(start, small_t1.shape, strict=True))
    t1_data, label_data = t1.data.copy(), labels.data.copy()
    t1_data[window], label_data[window] = small_t1.data, small_labels.data
    return Volume(t1_data, t1.T_patient_voxel), Volume(label_data, labels.T_patient_voxel)

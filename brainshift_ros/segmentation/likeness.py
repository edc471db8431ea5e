"""How alike the template and a patient image are once the template is moved onto it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.image.grid import Grid
from brainshift_ros.image.resample import sample
from brainshift_ros.image.volume import Volume
from brainshift_ros.segmentation.working_images import WorkingImages
from brainshift_ros.units import m_to_mm

_BINS = 32
#: The template's brain is brighter than this share of its maximum: half of grey matter, where a smoothed edge lies.
_BRAIN_LEVEL = 0.3
#: Thickness of the layer below the brain's surface whose intensities do not count.
_DEPTH_MM = 8.0


@dataclass(frozen=True)
class Likeness:
    """Agreement of intensities inside the template's brain, the tumour left out.

    Its outer layer is left out, too: any bright body of a brain's size has a bright inside and a dark outside.

    Attributes
    ----------
    seen
        Share of the template's healthy brain that comes to lie inside the patient's image.
    correlation_ratio
        eta^2 = 1 - E[Var(patient | template)] / Var(patient), 0 to 1, over what is seen of the inside (Roche et al. 1998):
        how far the template's intensity explains the patient's, by any function.
    """

    seen: float
    correlation_ratio: float

    @property
    def score(self) -> float:
        """What to compare two transforms by: agreement cannot be bought by moving the brain out of the image."""
        return self.seen * self.correlation_ratio


def likeness(images: WorkingImages, to_patient: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Likeness:
    """Compare the images under a map of template points, shape (n, 3), metres, to the patient."""
    grid = Grid.of(images.fixed)
    filled = ndimage.binary_fill_holes(images.fixed.data > _BRAIN_LEVEL * images.fixed.data.max())
    brain = np.argwhere(filled)
    depth_mm = ndimage.distance_transform_edt(filled, sampling=m_to_mm(grid.voxel_edges))[filled]
    y = to_patient(grid.centres(brain))
    known = sample(images.known, y, "nearest") > 0
    # Beyond its grid the sampled mask is zero, too: only a zero inside the grid is tumour.
    tumor = sample(_tumor(images), y, "nearest") > 0
    seen = float(known.sum() / max(1, np.count_nonzero(~tumor)))
    inner = known & (depth_mm > _DEPTH_MM)
    if np.count_nonzero(inner) < 2:
        return Likeness(seen, 0.0)
    a = images.fixed.data[tuple(brain[inner].T)].astype(np.float64)
    b = sample(images.moving, y[inner])
    if a.std() == 0.0 or b.std() == 0.0:
        return Likeness(seen, 0.0)
    bins = np.minimum((a / a.max() * _BINS).astype(int), _BINS - 1)
    count = np.maximum(np.bincount(bins, minlength=_BINS), 1)
    mean = np.bincount(bins, b, minlength=_BINS) / count
    return Likeness(seen, float(np.var(mean[bins]) / np.var(b)))


def _tumor(images: WorkingImages) -> Volume:
    return Volume(images.healthy.data == 0, images.healthy.T_patient_voxel)

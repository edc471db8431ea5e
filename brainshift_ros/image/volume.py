"""A 3-D image with its place in the patient frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Region(IntEnum):
    """Values of a label image (spec P1)."""

    OUTSIDE = 0
    LEFT_CEREBRUM = 1
    RIGHT_CEREBRUM = 2
    CEREBELLUM = 3
    BRAINSTEM = 4
    TUMOR = 5


@dataclass(frozen=True)
class Volume:
    """Voxels and the affine that places them.

    Attributes
    ----------
    data
        Voxel values, shape (I, J, K).
    T_patient_voxel
        4x4 affine from voxel indices (voxel centres at integers) to the patient frame (RAS+, metres).
    """

    data: NDArray
    T_patient_voxel: NDArray[np.float64]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along each index axis."""
        i, j, k = self.data.shape
        return i, j, k

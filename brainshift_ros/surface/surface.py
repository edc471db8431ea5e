"""Triangle surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Surface:
    """A triangle surface in the patient frame: vertices (V, 3) in metres, faces (F, 3), normals pointing outward."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]

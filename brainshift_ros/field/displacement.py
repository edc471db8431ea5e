"""A displacement field at the nodes of a mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class DisplacementField:
    """Forward displacement: a material point at `x` before surgery is at `x + u(x)` now.

    Attributes
    ----------
    mesh
        The mesh that carries the field.
    displacement
        Shape (N, 3), metres, patient frame.
    std
        Shape (N,), standard deviation of a displacement component, metres.
    provenance
        JSON-able facts: ``patient_id``, ``atlas_id``, weights, validity, software version; ``resected_share``, which part
        of the weights belongs to columns without the tumour.
    """

    mesh: TetMesh
    displacement: NDArray[np.float64]
    std: NDArray[np.float64]
    provenance: Mapping[str, Any]

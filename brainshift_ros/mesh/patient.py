"""What is known of a patient before surgery."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.segmentation.template_map import TemplateMap
from brainshift_ros.surface.surface import Surface


class Tissue(IntEnum):
    """Material class of an element (spec P6, table 1)."""

    WHITE = 1
    GREY = 2
    TUMOR = 3


@dataclass(frozen=True)
class ImageReference:
    """The MR that the patient model was made from: enough to recognise it and to resample onto its grid."""

    name: str
    sha256: str
    shape: tuple[int, int, int]
    T_patient_voxel: NDArray[np.float64]


@dataclass(frozen=True)
class PatientModel:
    """Mesh, tissue and surfaces of one patient.

    Attributes
    ----------
    mesh
        Tetrahedra, split along the septa, conforming to the tumour.
    tissue
        Shape (M,), :class:`Tissue` of each element.
    cortex
        Fine cortical surface from the MR: the target of scan registration.
    image
        The MR's identity and grid.
    quality
        Mesh quality figures by name (``dihedral_min_deg``, ``inverted``, ``volume_error_percent``, ...).
    warnings
        What a person should know before trusting the model.
    patient_id
        Hex SHA-256 over the model's arrays; atlases and fields carry it, so that foreign ones are recognised.
    template_map
        The registration of the template that labels or septa came from; None if both came from a person.
    """

    mesh: TetMesh
    tissue: NDArray[np.uint8]
    cortex: Surface
    image: ImageReference
    quality: Mapping[str, float]
    warnings: tuple[str, ...]
    patient_id: str
    template_map: TemplateMap | None = None

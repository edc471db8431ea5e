"""What several test modules share."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.h5 import digest
from brainshift_ros.image.volume import Volume
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.template_patient import template_patient_images
from brainshift_ros.septa.template import septa_from_template


@pytest.fixture(scope="session")
def template_case() -> tuple[Volume, Volume]:
    """T1 and labels of the template with a tumour, every second voxel along each axis: a real brain, small."""
    images = template_patient_images()
    t1, labels = images.t1, images.labels
    T = t1.T_patient_voxel @ np.diag([2.0, 2.0, 2.0, 1.0])
    return Volume(t1.data[::2, ::2, ::2], T), Volume(labels.data[::2, ::2, ::2], T)


@pytest.fixture(scope="session")
def small_patient(template_case: tuple[Volume, Volume]) -> PatientModel:
    """A patient model of about 3,000 nodes with tumour and split septa."""
    t1, labels = template_case
    image = ImageReference("template.nii.gz", digest(t1.data), t1.shape, t1.T_patient_voxel)
    septa = septa_from_template(lambda points: points, spacing_mm=9.0)
    return build_patient(t1, labels, septa, image_ref=image, nodes=3_000)

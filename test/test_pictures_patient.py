"""The patient page, also for a head that faces the light exactly (once brighter than white, which matplotlib refuses)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import unit
from brainshift_ros.pictures.patient_page import patient_page


def test_a_septum_that_faces_the_light_is_drawn(small_patient, template_case, tmp_path):
    mesh = small_patient.mesh
    corners = mesh.nodes[mesh.facets["falx"][0]]
    normal = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    turn, _ = Rotation.align_vectors([unit([-0.7, -0.3, 0.65])], [normal])
    turned = replace(small_patient, mesh=replace(mesh, nodes=turn.apply(mesh.nodes)))
    patient_page(turned, *template_case, tmp_path / "page.png")
    assert imread(tmp_path / "page.png")[..., :3].std() > 0.1

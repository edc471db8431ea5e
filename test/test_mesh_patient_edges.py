"""Tumours and images that are awkward to mesh: each ends in a mesh that passes the gate, or in one clear error."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.image.template import template_landmarks
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mechanics.resection import solved_elements
from brainshift_ros.mechanics.submesh import unsupported_elements
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.quality import refuse_bad_mesh
from brainshift_ros.mesh.template_patient import template_patient_images
from brainshift_ros.mesh.tumors import meshed_tumor
from brainshift_ros.septa.sheets import septa_from_landmarks
from brainshift_ros.surface.facets import components, face_table
from brainshift_ros.units import m_to_mm

ML = 1e-6


def places_mm(labels: Volume) -> np.ndarray:
    return m_to_mm(transform_points(labels.T_patient_voxel, np.moveaxis(np.indices(labels.shape), 0, -1)))


def with_balls(labels: Volume, *balls: tuple[tuple[float, float, float], float]) -> Volume:
    """The brain without its tumour, and with balls of tumour (centre and radius in mm) as far as they lie in it."""
    data = np.where(labels.data == Region.TUMOR, np.uint8(Region.LEFT_CEREBRUM), labels.data)
    for centre, radius in balls:
        ball = np.linalg.norm(places_mm(labels) - np.array(centre), axis=-1) < radius
        data = np.where(ball & (data > 0), np.uint8(Region.TUMOR), data)
    return Volume(data, labels.T_patient_voxel)


def built(t1: Volume, labels: Volume, nodes: int = 2000, **options: object) -> PatientModel:
    septa = septa_from_landmarks(template_landmarks().septa, spacing_mm=10.0)
    image = ImageReference("t1", "0" * 64, t1.shape, t1.T_patient_voxel)
    patient = build_patient(t1, labels, septa, image_ref=image, nodes=nodes, **options)  # type: ignore[arg-type]
    refuse_bad_mesh(patient.quality)
    return patient


def tumour_of(labels: Volume) -> float:
    return float(abs(np.linalg.det(labels.T_patient_voxel[:3, :3])) * np.count_nonzero(labels.data == Region.TUMOR))


def test_tumour_that_touches_the_brain_s_surface(template_case: tuple[Volume, Volume]) -> None:
    t1, labels = template_case
    labels = with_balls(labels, ((-45.0, 40.0, 40.0), 16.0))
    patient = built(t1, labels)
    mesh = patient.mesh
    tumor = mesh.region == Region.TUMOR
    assert mesh.volumes[tumor].sum() == pytest.approx(tumour_of(labels), rel=0.03)
    # its own elements reach the skull, with faces, and no layer of brain is left between
    skull = {tuple(f) for f in np.sort(mesh.facets["skull"], axis=1)}
    table = face_table(mesh.elements)
    outside = np.array([tuple(f) in skull for f in np.sort(table.boundary, axis=1)]) & tumor[table.boundary_owner]
    corners = mesh.nodes[table.boundary[outside]]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert area > 3e-4


def test_tumour_across_the_falx_stays_whole(template_case: tuple[Volume, Volume]) -> None:
    t1, labels = template_case
    labels = with_balls(labels, ((2.0, 40.0, 42.0), 14.0))
    mesh = built(t1, labels).mesh
    tumor = np.flatnonzero(mesh.region == Region.TUMOR)
    assert (mesh.nodes[mesh.elements[tumor]].mean(axis=1)[:, 0] > 0.004).any()
    assert (mesh.nodes[mesh.elements[tumor]].mean(axis=1)[:, 0] < -0.004).any()
    # one body: its elements are joined by faces, through the plane of the falx
    alone = face_table(mesh.elements[tumor]).owners
    assert components(len(tumor), alone).max() == 0
    # and the falx is still cut around it, not in it
    centres = mesh.nodes[mesh.facets["falx"]].mean(axis=1)
    assert np.linalg.norm(centres - np.array([0.002, 0.040, 0.042]), axis=1).min() > 0.010
    # resected, what is left of the brain still holds together; crumbs between tumour and falx may go with the tumour (in
    # few of the mesher's draws there are any), and are named
    left, warnings = solved_elements(mesh, resected=True, septa=True)
    assert not unsupported_elements(left.mesh, np.zeros(len(left.mesh.elements), dtype=bool)).any()
    assert (left.mesh.volumes > 0).all()
    crumbs = np.setdiff1d(np.flatnonzero(mesh.region != Region.TUMOR), left.parent_element)
    assert mesh.volumes[crumbs].sum() < 0.1 * mesh.volumes[tumor].sum()
    assert bool(warnings) == bool(len(crumbs))


def test_two_tumours_are_both_meshed_and_a_crumb_is_named(template_case: tuple[Volume, Volume]) -> None:
    t1, labels = template_case
    labels = with_balls(labels, ((-28.0, 34.0, 23.0), 13.0), ((35.0, -30.0, 30.0), 8.0), ((25.0, 40.0, 20.0), 2.2))
    patient = built(t1, labels)
    mesh = patient.mesh
    assert patient.quality["tumor_pieces"] == 2
    for number, ml in ((1, 4.0 / 3.0 * np.pi * 1.3**3), (2, 4.0 / 3.0 * np.pi * 0.8**3)):
        assert patient.quality[f"tumor_{number}_ml"] == pytest.approx(ml, rel=0.06)  # a ball of 2 mm voxels
    assert any("a piece of tumour below 0.1 ml" in warning for warning in patient.warnings)
    # the named facets enclose both, by the divergence theorem
    a, b, c = np.moveaxis(mesh.nodes[mesh.facets["tumor"]], 1, 0)
    both = mesh.volumes[mesh.region == Region.TUMOR].sum()
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(both, rel=1e-9)
    right = mesh.nodes[np.unique(mesh.facets["tumor"])][:, 0] > 0
    assert right.any()
    assert not right.all()


def test_brain_cut_by_the_image_s_edge_with_a_known_craniotomy(template_case: tuple[Volume, Volume]) -> None:
    t1, labels = template_case
    window = np.s_[12:, :, : int(0.8 * t1.shape[2])]
    T = t1.T_patient_voxel.copy()
    T[:3, 3] += T[:3, 0] * 12
    t1, labels = Volume(t1.data[window], T), Volume(labels.data[window], T)
    centre, radius = np.array([-0.035, 0.045, 0.040]), 0.03
    patient = built(t1, labels, craniotomy=(centre, radius))
    mesh = patient.mesh
    voxel = abs(np.linalg.det(T[:3, :3]))
    assert mesh.volumes.sum() == pytest.approx(voxel * np.count_nonzero(labels.data), rel=0.01)
    assert not any("craniotomy" in warning for warning in patient.warnings)
    # elements at the opening are smaller than at its mirror image; both sides are alike else
    size = np.cbrt(mesh.volumes)
    centres = mesh.nodes[mesh.elements].mean(axis=1)
    at_opening = (np.linalg.norm(centres - centre, axis=1) < radius) & (mesh.region != Region.TUMOR)
    opposite = np.linalg.norm(centres - centre * [-1, 1, 1], axis=1) < radius
    assert np.median(size[at_opening]) < 0.85 * np.median(size[opposite])


def test_thick_slices(template_case: tuple[Volume, Volume]) -> None:
    images = template_patient_images()
    T = images.t1.T_patient_voxel @ np.diag([1.0, 2.0, 3.0, 1.0])
    t1, labels = Volume(images.t1.data[:, ::2, ::3], T), Volume(images.labels.data[:, ::2, ::3], T)
    mesh = built(t1, labels).mesh
    _, fine = template_case
    assert mesh.volumes.sum() == pytest.approx(8e-9 * np.count_nonzero(fine.data), rel=0.02)


def test_tumour_that_is_only_a_crumb_is_refused(template_case: tuple[Volume, Volume]) -> None:
    t1, labels = template_case
    labels = with_balls(labels, ((-28.0, 34.0, 23.0), 2.0))
    with pytest.raises(InputError, match=r"largest piece of tumour holds 0\.0\d+ ml, too little to mesh"):
        built(t1, labels)


def test_pieces_are_numbered_by_size_and_joined_over_corners() -> None:
    data = np.zeros((20, 20, 20), np.uint8)
    data[1:4, 1:4, 1:4] = Region.TUMOR
    data[4, 4, 4] = Region.TUMOR  # touches it at a corner
    data[10:18, 10:18, 10:18] = Region.TUMOR
    pieces, warnings = meshed_tumor(Volume(data, np.diag([2e-3, 2e-3, 2e-3, 1.0])))
    assert (pieces[10, 10, 10], pieces[1, 1, 1], pieces[4, 4, 4], pieces[0, 0, 0]) == (1, 2, 2, 0)
    assert warnings == ()
    pieces, warnings = meshed_tumor(Volume(data, np.diag([1e-3, 1e-3, 1e-3, 1.0])))
    assert pieces.max() == 1
    assert pieces[1, 1, 1] == 0
    assert "0.028 ml" in warnings[0]


def test_labels_without_tumour_have_no_piece() -> None:
    pieces, warnings = meshed_tumor(Volume(np.ones((4, 4, 4), np.uint8), np.eye(4)))
    assert pieces.max() == 0
    assert warnings == ()

"""Segmentation from end to end on patients whose truth is known; the edges of spec E8."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from brainshift_ros.errors import InputError
from brainshift_ros.evaluation.overlap import dice
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.template import template_landmarks
from brainshift_ros.image.tumor import TumorShape
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.segmentation.segment import Segmentation, segment
from brainshift_ros.segmentation.settings import SegmentationSettings
from brainshift_ros.septa.sheets import septa_from_landmarks
from brainshift_ros.simulation.synthetic_patient import SyntheticPatient, synthetic_patient
from brainshift_ros.units import m_to_mm

COARSE = SegmentationSettings(spacing_mm=4.0, iterations=(50, 30, 20), threads=1)
TUMOR = TumorShape()


def overlap(found: Segmentation, truth: Volume) -> dict[str, float]:
    labels = {"brain": dice(found.labels.data > 0, truth.data > 0)}
    for region in (Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM, Region.CEREBELLUM, Region.BRAINSTEM):
        labels[region.name.lower()] = dice(found.labels.data == region, truth.data == region)
    return labels


def septa_error_mm(found: Segmentation, patient: SyntheticPatient) -> float:
    x = np.vstack([s.surface.vertices for s in septa_from_landmarks(template_landmarks().septa, 5.0)])
    return float(m_to_mm(np.linalg.norm(found.template_map.to_patient(x) - patient.to_patient(x), axis=1)).mean())


def stored_otherwise(volume: Volume) -> Volume:
    """The same image with its axes permuted and two of them run backwards; its affine says so."""
    data = volume.data.transpose(2, 0, 1)[::-1, ::-1]
    J = np.zeros((4, 4))
    # Old index from new index: i = I - 1 - b, j = c, k = K - 1 - a.
    J[0, 1], J[1, 2], J[2, 0], J[3, 3] = -1.0, 1.0, -1.0, 1.0
    J[0, 3], J[2, 3] = volume.shape[0] - 1, volume.shape[2] - 1
    return Volume(np.ascontiguousarray(data), volume.T_patient_voxel @ J)


@pytest.fixture(scope="module")
def thick_slices() -> SyntheticPatient:
    return synthetic_patient(5, whole_head=True, tumor=TUMOR, spacing_mm=(2.0, 2.0, 3.0), tilt_deg=15.0, offset_mm=30.0)


def test_whole_head_of_thick_slices_stored_backwards_is_segmented(thick_slices: SyntheticPatient) -> None:
    patient = thick_slices
    assert patient.tumor is not None
    steps = []
    found = segment(
        stored_otherwise(patient.t1),
        tumor=stored_otherwise(patient.tumor),
        settings=COARSE,
        progress=lambda stage, fraction: steps.append((stage, fraction)),
    )
    truth = stored_otherwise(patient.labels)
    scores = overlap(found, truth)
    assert scores["brain"] > 0.95
    assert min(scores["left_cerebrum"], scores["right_cerebrum"]) > 0.93
    assert scores["cerebellum"] > 0.88
    assert scores["brainstem"] > 0.8
    assert septa_error_mm(found, patient) < 2.5
    assert np.mean(found.labels.data[truth.data == Region.TUMOR] == Region.TUMOR) > 0.9
    assert found.warnings == ()
    assert {stage for stage, _ in steps} == {"segmentation"}
    fractions = [fraction for _, fraction in steps]
    assert fractions[-1] == 1.0
    assert min(fractions) > 0.0
    x = patient.to_patient(np.array([[0.03, -0.02, 0.02], [-0.03, -0.02, 0.02]]))
    left_right = found.labels.data[tuple(np.rint(Grid.of(found.labels).to_voxels(x)).astype(int).T)]
    assert left_right.tolist() == [Region.RIGHT_CEREBRUM, Region.LEFT_CEREBRUM]


def bright_body() -> Volume:
    """An ellipsoid of a brain's size with a brighter core, and noise."""
    x, y, z = np.indices((66, 76, 66)) - np.array([33, 38, 33])[:, None, None, None]
    outer, core = ((x / a) ** 2 + (y / b) ** 2 + (z / a) ** 2 < 1.0 for a, b in ((22, 28), (14, 18)))
    noise = np.random.default_rng(0).normal(500.0, 50.0, x.shape)
    return Volume(((0.6 * outer + 0.4 * core) * noise).astype(np.float32), np.diag([0.003, 0.003, 0.003, 1.0]))


def test_bright_body_is_refused() -> None:
    with pytest.raises(InputError, match="does not look like a head"):
        segment(bright_body(), settings=COARSE)


def test_head_upside_down_is_refused(thick_slices: SyntheticPatient) -> None:
    turned = np.diag([1.0, -1.0, -1.0, 1.0]) @ thick_slices.t1.T_patient_voxel
    with pytest.raises(InputError, match="orientation"):
        segment(Volume(thick_slices.t1.data, turned), settings=COARSE)


@pytest.mark.slow
@pytest.mark.parametrize("whole_head", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_default_settings_meet_the_targets(seed: int, whole_head: bool) -> None:
    patient = synthetic_patient(seed, whole_head=whole_head, tumor=TUMOR)
    found = segment(patient.t1, tumor=patient.tumor)
    scores = overlap(found, patient.labels)
    assert scores["brain"] >= 0.97
    assert scores["brainstem"] >= 0.85
    assert septa_error_mm(found, patient) <= 2.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "least_brain"),
    [
        ({"noise": 0.2}, 0.95),
        ({"tilt_deg": 22.0, "offset_mm": 50.0}, 0.95),
        ({"noise": 0.2, "whole_head": False}, 0.95),
        ({"spacing_mm": (1.0, 3.0, 1.0), "whole_head": False}, 0.95),
    ],
)
def test_hard_images_are_segmented(change: dict, least_brain: float) -> None:
    patient = synthetic_patient(7, **{"whole_head": True, "tumor": TUMOR, **change})
    found = segment(patient.t1, tumor=patient.tumor, settings=dataclasses.replace(COARSE, spacing_mm=3.0))
    assert overlap(found, patient.labels)["brain"] >= least_brain
    assert septa_error_mm(found, patient) < 3.0


@pytest.mark.slow
def test_brain_cut_by_the_edge_is_segmented_and_said() -> None:
    patient = synthetic_patient(8, whole_head=True, tilt_deg=3.0)
    brain = np.argwhere(patient.labels.data > 0)
    cut = int(np.quantile(brain[:, 2], 0.15))
    T_patient_voxel = patient.t1.T_patient_voxel.copy()
    T_patient_voxel[:3, 3] += T_patient_voxel[:3, 2] * cut
    found = segment(Volume(patient.t1.data[:, :, cut:], T_patient_voxel), settings=dataclasses.replace(COARSE, spacing_mm=3.0))
    assert any("cut by the image's edge" in warning for warning in found.warnings)
    assert dice(found.labels.data > 0, patient.labels.data[:, :, cut:] > 0) >= 0.95

"""From the MR of a whole head alone: `brainshift patient`, `segment` and `compare`, against the truth."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from brainshift_ros.cli import compare, patient, segment
from brainshift_ros.image.io import read_volume, write_volume
from brainshift_ros.image.template import template_labels, template_landmarks
from brainshift_ros.image.tumor import TumorShape
from brainshift_ros.image.volume import Region
from brainshift_ros.mesh.patient_file import read_patient
from brainshift_ros.segmentation.segment import Segmentation, carried
from brainshift_ros.septa.files import write_septa
from brainshift_ros.simulation.synthetic_patient import synthetic_patient


def run(command, *arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments], catch_exceptions=False, standalone_mode=False)


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """A whole head of 2 mm voxels and its tumour mask, in files; with the truth."""
    folder = tmp_path_factory.mktemp("head")
    truth = synthetic_patient(4, whole_head=True, tumor=TumorShape(), spacing_mm=2.0)
    write_volume(folder / "t1.nii.gz", truth.t1)
    write_volume(folder / "tumor.nii.gz", truth.tumor)
    write_volume(folder / "manual.nii.gz", truth.labels)
    write_septa(folder / "manual.vtu", truth.septa)
    return folder, truth


@pytest.fixture(scope="module")
def made(head):
    """The patient file that comes of T1 and tumour mask alone."""
    folder, _ = head
    run(patient.command, folder / "t1.nii.gz", "--tumor", folder / "tumor.nii.gz", "--nodes", 2000, "-o", folder / "p.h5")
    return read_patient(folder / "p.h5")


def test_a_whole_head_becomes_a_patient(head, made):
    folder, truth = head
    assert {"skull", "falx", "tentorium", "tumor"} <= set(made.mesh.facets)
    voxel_ml = 8e-3
    for region, tolerance in ((Region.CEREBELLUM, 0.12), (Region.BRAINSTEM, 0.25), (Region.TUMOR, 0.03)):
        expected = voxel_ml * np.count_nonzero(truth.labels.data == region)
        assert 1e6 * made.mesh.volumes[made.mesh.region == region].sum() == pytest.approx(expected, rel=tolerance)
    expected = voxel_ml * np.count_nonzero(truth.labels.data)
    assert 1e6 * made.mesh.volumes.sum() == pytest.approx(expected, rel=0.05)
    assert (folder / "p.png").stat().st_size > 100_000


def test_the_transform_is_kept_with_the_patient(head, made):
    _, truth = head
    points = np.array([[-0.03, 0.03, 0.03], [0.03, -0.05, 0.03], [0.0, -0.03, -0.03], [0.02, -0.06, -0.04], [0.0, 0.02, 0.05]])
    error = np.linalg.norm(made.template_map.to_patient(points) - truth.to_patient(points), axis=1)
    assert error.mean() < 0.0025
    back = made.template_map.to_template(made.template_map.to_patient(points))
    assert back == pytest.approx(points, abs=1e-4)


def test_segmentation_is_written_and_compared_with_a_person_s(head, made, monkeypatch):
    folder, _ = head

    def found(t1, *, tumor, progress):
        assert tumor is None
        return Segmentation(carried(template_labels(template_landmarks()), made.template_map, t1), made.template_map, (), {})

    monkeypatch.setattr(segment, "segment", found)
    run(segment.command, folder / "t1.nii.gz", "--septa", folder / "auto.vtu", "-o", folder / "auto.nii.gz")
    assert np.unique(read_volume(folder / "auto.nii.gz").data).tolist() == [0, 1, 2, 3, 4]
    septa = ("--septa", folder / "auto.vtu", folder / "manual.vtu")
    result = run(compare.command, folder / "auto.nii.gz", folder / "manual.nii.gz", *septa, "-o", folder / "report.json")
    assert "slices with errors" in result.output
    report = json.loads((folder / "report.json").read_text())
    assert report["regions"]["brain"]["dice"] > 0.95
    assert report["regions"]["brainstem"]["dice"] > 0.85
    assert 0.0 < report["septa"]["all"]["to_manual"]["mean_mm"] < 2.5

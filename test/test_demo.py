"""The whole job, small: mesh, atlas, simulated case, the four nodes as processes, field, pictures, summary."""

from __future__ import annotations

import json

import pytest
import SimpleITK as sitk  # noqa: N813

from brainshift_ros.atlas.scene import read_scene
from brainshift_ros.demo.run import run_demo
from brainshift_ros.demo.settings import DemoFiles, DemoSettings
from brainshift_ros.image.template import template_t1
from brainshift_ros.resources import resource

SMALL = DemoSettings(nodes=3_000, truth_nodes=2_500, septa_spacing_mm=9.0)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    scene = read_scene(resource("config/scene_demo.yaml"))
    assert scene.gravity is not None
    few = scene.gravity.model_copy(update={"orientations": 8})
    folder = tmp_path_factory.mktemp("demo")
    told: list[tuple[str, float]] = []
    summary = run_demo(
        scene.model_copy(update={"gravity": few}), SMALL, folder, lambda stage, fraction: told.append((stage, fraction))
    )
    return summary, folder, told


@pytest.mark.integration
def test_summary_says_what_was_reached(demo):
    summary, folder, _ = demo
    assert json.loads((folder / "summary.json").read_text()) == json.loads(json.dumps(summary))
    assert summary["field_valid"] is True
    assert summary["atlas_entries"] == 16
    assert summary["homologous_points"] >= 15
    assert summary["registration_tre_mm"] < 1.0
    assert summary["shift_mm_mean"] > 3.0
    # Meshes this coarse lock and differ by more than the demo's own: the full demo is held to 85 and 75 %.
    assert summary["correction_surface_percent"] > 70.0
    assert summary["correction_subsurface_percent"] > 60.0
    assert {"image", "mesh", "atlas", "case", "graph", "field", "pictures", "total", "scan_to_field"} <= set(summary["times_s"])


@pytest.mark.integration
def test_every_stage_reports_its_progress(demo):
    _, _, told = demo
    assert [stage for stage, fraction in told if fraction == 1.0 and ":" not in stage] == [
        "image",
        "mesh",
        "atlas",
        "case",
        "graph",
        "field",
        "pictures",
    ]


@pytest.mark.integration
def test_updated_mr_is_what_itk_makes_of_the_transform(demo):
    _, folder, _ = demo
    files = DemoFiles(folder)
    before, after = sitk.ReadImage(str(files.t1)), sitk.ReadImage(str(files.warped))
    transform = sitk.DisplacementFieldTransform(sitk.ReadImage(str(files.transform), sitk.sitkVectorFloat64))
    by_itk = sitk.GetArrayFromImage(sitk.Resample(before, after, transform, sitk.sitkLinear))
    assert abs(by_itk - sitk.GetArrayFromImage(after)).mean() < 1e-3 * template_t1().data.max()


@pytest.mark.integration
def test_results_and_pictures_are_there_and_nothing_half_written(demo):
    _, folder, _ = demo
    names = {path.name for path in folder.iterdir()}
    pictures = {"patient.png", "scan_vessels.png", "mr_before_after.png", "displacement_mm.png", "vectors.png", "boundary.png"}
    files = {"patient.h5", "atlas.h5", "case.mcap", "session.mcap", "field.h5", "displacement_forward.nii.gz", "summary.json"}
    assert pictures | files <= names
    assert not [name for name in names if name.startswith(".part")]

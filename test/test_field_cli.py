"""`brainshift solve`, `warp` and `sample`, as a person uses them."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import jsonschema
import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from click.testing import CliRunner
from field_cases import ellipsoid_mesh, sagging_atlas, smooth_field, top_nodes

from brainshift_ros.atlas.file import AtlasContent, write_atlas
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.cli import sample, solve, warp
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.field_file import read_field, write_field
from brainshift_ros.field.surfaces import read_surface
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.io import read_volume, write_volume
from brainshift_ros.image.volume import Volume
from brainshift_ros.inverse.points_csv import write_homologous_points
from brainshift_ros.inverse.shift_estimate import json_schema
from brainshift_ros.mesh.nearest import boundary_faces

MESH = ellipsoid_mesh(8)
ATLAS = sagging_atlas(MESH, entries=12)
GRID = Grid((30, 32, 28), np.array([[-0.005, 0, 0, 0.072], [0, 0.005, 0, -0.08], [0, 0, 0.005, -0.068], [0, 0, 0, 1.0]]))


def run(module, *arguments):
    result = CliRunner().invoke(module.command, [str(argument) for argument in arguments], catch_exceptions=False)
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("case")
    tissue = np.ones(len(MESH.elements), np.uint8)
    scene = Scene.model_validate({"gravity": {"direction": [0.0, -1.0, 0.0]}})
    write_atlas(folder / "atlas.h5", AtlasContent(ATLAS.patient_id, MESH, tissue, scene, ATLAS.entries, ATLAS.groups), ATLAS.E)
    truth = ATLAS.E[:, :, :2].astype(float) @ [0.4, 0.3]
    nodes = top_nodes(MESH, 18)
    measured = HomologousPoints(MESH.nodes[nodes], truth[nodes], np.full(18, 5e-4))
    write_homologous_points(folder / "points.csv", measured)
    write_field(folder / "field.h5", smooth_field(MESH))
    rng = np.random.default_rng(0)
    image = (rng.uniform(50, 200, GRID.shape) * Deformation(smooth_field(MESH), 0.005).inside(GRID)).astype(np.int16)
    write_volume(folder / "t1.nii.gz", Volume(image, GRID.T_patient_voxel))
    return folder, truth


def test_solve_recovers_the_field(case, tmp_path):
    folder, truth = case
    status, output = run(
        solve, folder / "atlas.h5", folder / "points.csv", "-o", tmp_path / "f.h5", "--json", tmp_path / "e.json"
    )
    assert status == 0, output
    assert "valid: 18 of 18 points" in output
    field = read_field(tmp_path / "f.h5")
    np.testing.assert_allclose(field.displacement, truth, atol=1e-5)
    assert field.provenance["valid"] is True
    jsonschema.validate(json.loads((tmp_path / "e.json").read_text()), json_schema())


def test_solve_says_when_the_estimate_is_not_valid(case, tmp_path):
    folder, _ = case
    lines = (folder / "points.csv").read_text().splitlines()
    (tmp_path / "few.csv").write_text("\n".join(lines[:3]))
    status, output = run(solve, folder / "atlas.h5", tmp_path / "few.csv", "-o", tmp_path / "f.h5")
    assert status == solve.NOT_VALID
    assert "NOT VALID (2 points in use, 5 are needed)" in output
    assert read_field(tmp_path / "f.h5").provenance["valid"] is False


def test_warp_writes_image_and_transform_that_simpleitk_agrees_with(case, tmp_path):
    folder, _ = case
    status, output = run(
        warp, folder / "field.h5", folder / "t1.nii.gz", "-o", tmp_path / "w.nii.gz", "--transform", tmp_path / "t.nii.gz"
    )
    assert status == 0, output
    ours = read_volume(tmp_path / "w.nii.gz")
    moving = sitk.ReadImage(str(folder / "t1.nii.gz"))
    field = sitk.Cast(sitk.ReadImage(str(tmp_path / "t.nii.gz")), sitk.sitkVectorFloat64)
    theirs = sitk.Resample(moving, moving, sitk.DisplacementFieldTransform(field), sitk.sitkLinear, 0.0)
    assert np.abs(ours.data.astype(int) - sitk.GetArrayFromImage(theirs).T).max() <= 1  # rounding of halves
    assert ours.data.dtype == np.int16


def test_warp_keeps_labels(case, tmp_path):
    folder, _ = case
    labels = Volume((read_volume(folder / "t1.nii.gz").data > 100).astype(np.uint8) * 3, GRID.T_patient_voxel)
    write_volume(tmp_path / "l.nii.gz", labels)
    coarse = Volume(labels.data[::2, ::2, ::2], GRID.T_patient_voxel @ np.diag([2.0, 2.0, 2.0, 1.0]))
    write_volume(tmp_path / "coarse.nii.gz", coarse)
    arguments = ("--labels", tmp_path / "l.nii.gz", tmp_path / "one.nii.gz", "--labels", tmp_path / "coarse.nii.gz")
    status, output = run(
        warp, folder / "field.h5", folder / "t1.nii.gz", "-o", tmp_path / "w.nii.gz", *arguments, tmp_path / "two.nii.gz"
    )
    assert status == 0, output
    one, two = read_volume(tmp_path / "one.nii.gz"), read_volume(tmp_path / "two.nii.gz")
    assert set(np.unique(one.data)) == set(np.unique(two.data)) == {0, 3}
    assert two.shape == coarse.shape
    status, output = run(warp, folder / "field.h5", tmp_path / "l.nii.gz", "-o", tmp_path / "w.nii.gz", "--image-is-labels")
    assert status == 0, output
    np.testing.assert_array_equal(read_volume(tmp_path / "w.nii.gz").data, one.data)


def test_warp_writes_std_surfaces_and_checks(case, tmp_path):
    folder, _ = case
    faces, _ = boundary_faces(MESH.elements)
    field = replace(smooth_field(replace(MESH, facets={"skull": faces.astype(np.int32)})), provenance={"resected_share": 0.8})
    write_field(tmp_path / "f.h5", field)
    status, output = run(
        warp, tmp_path / "f.h5", folder / "t1.nii.gz", "-o", tmp_path / "w.nii.gz", "--std", tmp_path / "s.nii.gz",
        "--surface", "brain", tmp_path / "b.ply", "--json", tmp_path / "c.json", "--gap", "0",
    )  # fmt: skip
    assert status == 0, output
    assert "forward after inverse, brain: mean 0.000, 95 % below 0.000, largest 0.000 mm" in output
    assert "note: the estimate says that the tumour was resected" in output
    checks = json.loads((tmp_path / "c.json").read_text())
    assert checks["folded_elements"] == 0
    assert checks["inverse_error"]["brain"]["max_mm"] < 1e-3
    assert len(checks["warnings"]) == 1
    std_mm = np.asarray(nib.load(tmp_path / "s.nii.gz").dataobj)
    assert np.nanmax(std_mm) == pytest.approx(1e3 * field.std.max(), rel=0.1)
    status, output = run(
        warp, folder / "field.h5", folder / "t1.nii.gz", "-o", tmp_path / "w.nii.gz",
        "--surface", tmp_path / "b.ply", tmp_path / "moved.vtu",
    )  # fmt: skip
    assert status == 0, output
    assert read_surface(tmp_path / "moved.vtu").faces.shape == faces.shape


def test_sample_gives_displacement_and_std_in_mm(case, tmp_path):
    folder, _ = case
    field = smooth_field(MESH)
    inner = MESH.nodes[[100, 200, 0]]  # the last is on the surface
    rows = [*(inner * 1000).tolist(), [0.0, 75.0, 0.0], [0.0, 300.0, 0.0]]
    (tmp_path / "p.csv").write_text("x,y,z\n" + "\n".join(",".join(map(str, row)) for row in rows))
    status, output = run(sample, folder / "field.h5", tmp_path / "p.csv", "-o", tmp_path / "s.csv")
    assert status == 0, output
    assert (tmp_path / "s.csv").read_text().splitlines()[0] == "x,y,z,dx,dy,dz,std,inside"
    table = np.genfromtxt(tmp_path / "s.csv", delimiter=",", skip_header=1)
    np.testing.assert_allclose(table[:3, 3:6], field.displacement[[100, 200, 0]] * 1000, atol=1e-5)
    np.testing.assert_allclose(table[:3, 6], field.std[[100, 200, 0]] * 1000, atol=1e-5)
    np.testing.assert_array_equal(table[:, 7], [1, 1, 1, 0, 0])
    assert np.isnan(table[3:, 6]).all()
    assert np.linalg.norm(table[3, 3:6]) > 0.1
    assert not table[4, 3:6].any()


@pytest.mark.parametrize(
    ("module", "arguments", "match"),
    [
        (solve, ("none.h5", "points.csv", "-o", "out.h5"), "none.h5: no such file"),
        (solve, ("field.h5", "points.csv", "-o", "out.h5"), "is not a brainshift atlas file"),
        (solve, ("atlas.h5", "t1.nii.gz", "-o", "out.h5"), "t1.nii.gz: is not a text file"),
        (warp, ("atlas.h5", "t1.nii.gz", "-o", "out.nii.gz"), "is not a brainshift field file"),
        (warp, ("field.h5", "points.csv", "-o", "out.nii.gz"), "is not a NIfTI image"),
        (warp, ("field.h5", "t1.nii.gz", "-o", "out.nii.gz", "--surface", "brain", "out.xyz"), "does not end in .vtu or"),
        (warp, ("field.h5", "t1.nii.gz", "-o", "out.nii.gz", "--surface", "falx", "out.vtu"), "not in the field's mesh"),
        (warp, ("field.h5", "t1.nii.gz", "-o", "out.nii.gz", "--surface", "none.vtu", "out.vtu"), "none.vtu: no such file"),
        (warp, ("field.h5", "t1.nii.gz", "-o", "out.nii.gz", "--labels", "none.nii", "out.nii"), "none.nii: no such file"),
        (warp, ("field.h5", "t1.nii.gz", "-o", "out.nii.gz", "--cavity", "0"), "has no tumour"),
        (sample, ("field.h5", "none.csv", "-o", "out.csv"), "none.csv: no such file"),
    ],
)
def test_wrong_input_is_one_clear_error(case, monkeypatch, module, arguments, match):
    folder, _ = case
    monkeypatch.chdir(folder)
    with pytest.raises(InputError, match=match):
        run(module, *arguments)
    assert not list(folder.glob("out.*"))


def test_the_command_ends_with_status_2_and_no_traceback(case, tmp_path):
    folder, _ = case
    (tmp_path / "bad.csv").write_text("1,2,3,0,zero,-5\n")
    arguments = ["solve", str(folder / "atlas.h5"), str(tmp_path / "bad.csv"), "-o", str(tmp_path / "f.h5")]
    ended = subprocess.run(
        [sys.executable, "-m", "brainshift_ros.cli.main", *arguments], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    assert "bad.csv: line 1, column dy: 'zero' is not a finite number" in ended.stderr
    assert "Traceback" not in ended.stderr

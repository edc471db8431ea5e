"""The block build against one factorisation for each entry, its interruption, and its command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from mechanics_cases import head, patient

from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.scene import Craniotomy, Gravity, Model, Scene
from brainshift_ros.cli.atlas import command
from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.forward import solve_gravity, solve_system
from brainshift_ros.mechanics.many import ManySolver
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system

PATIENT = patient(head(6))
SCENE = Scene(
    gravity=Gravity(direction=(0.0, -0.6, -0.8), cone_deg=25.0, orientations=6, fluid_levels=2),
    resection="both",
    craniotomy=Craniotomy(center_mm=(-20.0, 40.0, 50.0), diameter_mm=60.0),
)


@pytest.fixture(scope="module", params=["pardiso", "scipy"])
def built(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("build") / "atlas.h5"
    seen = []
    report = build_atlas(PATIENT, SCENE, path, solver=request.param, progress=lambda *step: seen.append(step))
    with open_atlas(path) as atlas:
        yield report, atlas, seen, request.param


def test_every_entry_equals_its_own_solution(built):
    _, atlas, _, solver = built
    material = material_of(PATIENT.tissue)
    assert len(atlas.entries) == 24
    for column, entry in enumerate(atlas.entries):
        alone = solve_gravity(
            PATIENT.mesh, material, entry.gravity_direction, entry.fluid_level, resected=entry.resected, solver=solver
        ).displacement
        assert np.abs(alone).max() > 1e-4
        # The file holds float32.
        np.testing.assert_allclose(atlas.columns([column])[:, :, 0], alone, atol=2e-7 * np.abs(alone).max())


@pytest.mark.parametrize("resected", [False, True])
@pytest.mark.parametrize("solver", ["pardiso", "scipy"])
def test_block_solutions_equal_refactoring_to_round_off(resected, solver):
    system = assemble_system(PATIENT.mesh, material_of(PATIENT.tissue), resected=resected, solver=solver)
    directions = np.array([[0.0, -0.6, -0.8], [0.3, -0.6, -0.74], [-0.3, -0.5, -0.8], [0.0, -0.1, -1.0]])
    many = ManySolver(system.stiffness, np.array([system.constrained(d) for d in directions]), solver)
    assert many.variable_count > 20
    loads = np.stack([system.gravity(d, 0.4) for d in directions], axis=1)
    for cases, solution, _ in many.solve(range(len(directions)), lambda cases: loads[:, cases]):
        fields = system.displacement(solution)
        for k, case in enumerate(cases):
            alone = solve_system(system, directions[case], 0.4, solver=solver).displacement
            assert np.linalg.norm(fields[:, :, k] - alone) <= 1e-11 * np.linalg.norm(alone)


def test_report_tells_how_the_build_went(built):
    report, atlas, seen, solver = built
    assert report.entries == 24
    assert report.solver == solver
    assert report.atlas_id == atlas.atlas_id
    assert report.residual < 1e-10
    shift = np.linalg.norm(atlas.columns(range(24)), axis=1)
    np.testing.assert_allclose(report.largest_shift, shift.max(axis=0), rtol=1e-6)
    assert np.all(report.craniotomy_shift <= report.largest_shift)
    assert set(report.times_s) == {"assemble", "factorise", "solve", "write"}
    fractions = [fraction for _, fraction in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_build_that_is_stopped_leaves_nothing_new(tmp_path):
    path = tmp_path / "atlas.h5"
    path.write_text("the old one")

    def stop(stage, fraction):
        if stage == "write":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_atlas(PATIENT, SCENE, path, progress=stop)
    assert [p.name for p in tmp_path.iterdir()] == ["atlas.h5"]
    assert path.read_text() == "the old one"


def test_faults_are_found_before_the_work(tmp_path):
    stages = []
    with pytest.raises(InputError, match="does not model"):
        build_atlas(
            PATIENT, SCENE.model_copy(update={"model": Model(skull="contact")}), tmp_path / "a.h5", progress=stages.append
        )
    with pytest.raises(InputError, match="its folder does not exist"):
        build_atlas(PATIENT, SCENE, tmp_path / "absent" / "a.h5", progress=stages.append)
    assert stages == []


def test_what_the_scene_asks_for_and_the_patient_lacks_is_said(tmp_path):
    mesh = PATIENT.mesh
    bare = replace(mesh, facets={name: facets for name, facets in mesh.facets.items() if name not in ("falx", "tentorium")})
    scene = SCENE.model_copy(
        update={
            "craniotomy": Craniotomy(center_mm=(500.0, 0.0, 0.0), diameter_mm=60.0),
            "gravity": Gravity(direction=(0.0, -0.6, -0.8), orientations=1, fluid_levels=1),
            "resection": "none",
        }
    )
    report = build_atlas(replace(PATIENT, mesh=bare), scene, tmp_path / "a.h5", solver="scipy")
    assert report.craniotomy_shift is None
    assert any("asks for septa" in warning for warning in report.warnings)
    assert any("no cortex lies under the craniotomy" in warning for warning in report.warnings)
    assert build_atlas(PATIENT, SCENE, tmp_path / "b.h5").warnings == ()


def run(*arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments])


@pytest.fixture
def scene_path(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text("gravity: {direction: [0.0, -0.6, -0.8], cone_deg: 20, orientations: 2, fluid_levels: 1}\n")
    return path


@pytest.fixture
def _patient_at_hand(monkeypatch):
    monkeypatch.setattr("brainshift_ros.cli.atlas.read_patient", lambda path: PATIENT)


@pytest.mark.usefixtures("_patient_at_hand")
def test_command_builds_and_shows(tmp_path, scene_path):
    result = run(scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5", "--solver", "scipy")
    assert result.exit_code == 0, result.output
    assert "2 entries by scipy" in result.output.replace("\n", " ")
    shown = run("--show", tmp_path / "atlas.h5")
    assert shown.exit_code == 0
    assert PATIENT.patient_id[:20] in shown.output
    assert "with tumour" in shown.output


@pytest.mark.usefixtures("_patient_at_hand")
def test_command_stopped_by_ctrl_c_leaves_no_file(tmp_path, scene_path, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("brainshift_ros.atlas.build.write_atlas", stopped)
    result = run(scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5")
    assert result.exit_code == 130
    assert "nothing was written" in result.output
    assert [p.name for p in tmp_path.iterdir()] == ["scene.yaml"]


@pytest.mark.usefixtures("_patient_at_hand")
def test_command_names_the_patient_whose_mesh_cannot_be_solved(tmp_path, scene_path, monkeypatch):
    monkeypatch.setattr("brainshift_ros.mechanics.solvers.RESIDUAL_LIMIT", 0.0)
    result = run(scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5")
    assert isinstance(result.exception, InputError)
    assert result.exception.source == "patient.h5"
    assert "residual" in result.exception.problem


@pytest.mark.usefixtures("_patient_at_hand")
def test_command_names_the_scene_file_that_asks_too_much(tmp_path, scene_path):
    scene_path.write_text("mannitol: {permeability_levels: 3}\n")
    result = run(scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5")
    assert isinstance(result.exception, InputError)
    assert result.exception.source == str(scene_path)


def test_command_without_arguments_says_what_it_needs():
    result = run()
    assert result.exit_code == 2
    assert "--patient" in result.output

"""The block build against one factorisation for each entry, its interruption, and its command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from mechanics_cases import head, patient

from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.problem import under_craniotomy
from brainshift_ros.atlas.scene import Craniotomy, Gravity, Mannitol, Model, Scene, Swelling, Transient
from brainshift_ros.cli.atlas import command
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.mechanics.cases import Case
from brainshift_ros.mechanics.deformation import JacobianOfElements
from brainshift_ros.mechanics.forward import solve_gravity
from brainshift_ros.mechanics.materials import TABLE_1, material_of
from brainshift_ros.mechanics.steady import SteadyModel
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mechanics.transient import TransientModel
from brainshift_ros.mesh.patient import Tissue

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
    material, opening = material_of(PATIENT.tissue), under_craniotomy(PATIENT.mesh, SCENE.craniotomy)
    assert len(atlas.entries) == 24
    assert SCENE.model.skull == "contact"  # the default
    for column, entry in enumerate(atlas.entries):
        alone = solve_gravity(
            PATIENT.mesh,
            material,
            entry.gravity_direction,
            entry.fluid_level,
            resected=entry.resected,
            skull="contact",
            opening=opening,
            solver=solver,
        ).displacement
        assert np.abs(alone).max() > 1e-4
        # The file holds float32.
        np.testing.assert_allclose(atlas.columns([column])[:, :, 0], alone, atol=2e-7 * np.abs(alone).max())


def test_report_tells_how_the_build_went(built):
    report, atlas, seen, solver = built
    assert report.entries == 24
    assert report.solver == solver
    assert report.atlas_id == atlas.atlas_id
    assert report.residual < 1e-10
    shift = np.linalg.norm(atlas.columns(range(24)), axis=1)
    np.testing.assert_allclose(report.largest_shift, shift.max(axis=0), rtol=1e-6)
    assert np.all(report.craniotomy_shift <= report.largest_shift)
    assert set(report.times_s) == {"assemble", "factorise", "solve", "check", "write"}
    assert sum(report.times_s.values()) <= report.wall_s
    assert report.resumed == 0
    np.testing.assert_array_equal(report.diagnostics, atlas.diagnostics)
    assert atlas.solver == solver
    fractions = [fraction for _, fraction in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


MIXED = Scene(
    gravity=Gravity(direction=(0.0, -0.6, -0.8), cone_deg=25.0, orientations=3, fluid_levels=1),
    mannitol=Mannitol(permeability_levels=2),
    swelling=Swelling(pressure_levels=2, margin_mm=10.0),
    resection="both",
    craniotomy=SCENE.craniotomy,
)
HOUR = Transient(duration_s=3600.0, dt_s=1800.0)


@pytest.mark.parametrize(
    "model",
    [Model(skull="free_cap"), Model(skull="contact"), Model(element="P2"), Model(time=HOUR)],
    ids=lambda model: str(model),
)
def test_each_column_is_the_solution_of_its_entry_alone(tmp_path, model):
    # Whatever the model: the columns of the file stand in the order of the entries, though they are solved in blocks.
    small = patient(head(4))
    scene = MIXED.model_copy(update={"model": model})
    report = build_atlas(small, scene, tmp_path / "a.h5", solver="scipy")
    with open_atlas(tmp_path / "a.h5") as atlas:
        entries, E, found = atlas.entries, atlas.columns(range(len(atlas.entries))), atlas.diagnostics
    assert len(entries) == 30
    opening = under_craniotomy(small.mesh, scene.craniotomy)
    jacobian = {False: JacobianOfElements(small.mesh), True: JacobianOfElements(small.mesh, small.mesh.region != Region.TUMOR)}
    systems = {
        resected: assemble_system(
            small.mesh, material_of(small.tissue), resected=resected, element=model.element, solver="scipy"
        )
        for resected in (False, True)
    }
    for column in range(0, 30, 4):
        entry = entries[column]
        settings = {"skull": model.skull, "opening": opening, "solver": "scipy"}
        if model.time == "steady":
            alone = SteadyModel(systems[entry.resected], [entry.gravity_direction], **settings)
        else:
            times = {"duration_s": HOUR.duration_s, "dt_s": HOUR.dt_s}
            alone = TransientModel(systems[entry.resected], [entry.gravity_direction], **times, **settings)
        case = Case(entry.mechanism, entry.gravity_direction, entry.fluid_level, entry.intensity, margin_mm=10.0)
        (block,) = alone.solve([case])
        u = block.displacement[:, :, 0]
        np.testing.assert_allclose(E[:, :, column], u, atol=2e-7 * np.abs(u).max())
        row = found[column]
        assert row["largest_shift"] == pytest.approx(np.linalg.norm(u, axis=1).max(), rel=1e-5)
        assert row["craniotomy_shift"] == pytest.approx(np.linalg.norm(u[opening], axis=1).max(), rel=1e-5)
        assert row["smallest_det_f"] == pytest.approx(jacobian[entry.resected](u[:, :, None]).smallest[0], abs=1e-4)
        assert row["closed_normals"] == block.closed_normals[0]
    for column, entry in enumerate(entries):
        if entry.mechanism == "swelling" and entry.drug_level == 2:  # as the report says: a scaled copy
            level_1, level_2 = E[:, :, column - 1], E[:, :, column]
            np.testing.assert_allclose(2.0 * level_1, level_2, atol=1e-6 * np.abs(level_2).max())
    assert any("scaled copies" in warning for warning in report.warnings)
    assert 0.0 < found["residual"].max() == report.residual < 1e-8
    assert (found["closed_normals"] > 0).any() == (model.skull == "contact")


@pytest.mark.parametrize("mechanism", ["gravity", "mannitol", "swelling"])
def test_the_inverse_finds_the_mechanism_that_acted(tmp_path, mechanism):
    scene = MIXED.model_copy(update={"resection": "none", "swelling": Swelling(pressure_levels=1)})
    build_atlas(PATIENT, scene, tmp_path / "a.h5", solver="scipy")
    cortex = np.unique(PATIENT.mesh.facets["skull"])[::3]
    with open_atlas(tmp_path / "a.h5") as atlas:
        # Of the planned orientation, at the lowest level of the drug.
        column = [entry.mechanism for entry in atlas.entries].index(mechanism)
        acted = 0.7 * atlas.columns([column])[:, :, 0].astype(float)
        measured = HomologousPoints(PATIENT.mesh.nodes[cortex], acted[cortex], np.full(len(cortex), 1e-5))
        estimate = estimate_shift(atlas, measured)
    assert estimate.mechanism_sums[mechanism] == pytest.approx(0.7, abs=0.03)
    assert estimate.weights[0].mechanism == mechanism


def test_gravity_alone_asks_for_no_pressure(tmp_path, monkeypatch):
    # E9: no pressure unknowns without mannitol, swelling or time.
    def refuse(*_):
        raise AssertionError("a fluid was assembled")

    monkeypatch.setattr("brainshift_ros.mechanics.system.fluid_of", refuse)
    scene = MIXED.model_copy(update={"mannitol": None, "swelling": None})
    assert build_atlas(PATIENT, scene, tmp_path / "a.h5", solver="scipy").entries == 6
    with pytest.raises(AssertionError, match="a fluid"):
        build_atlas(PATIENT, MIXED, tmp_path / "b.h5", solver="scipy")


def test_displacements_beyond_linear_theory_are_counted_and_said(tmp_path, monkeypatch):
    soft = {tissue: replace(values, youngs_modulus=values.youngs_modulus / 50.0) for tissue, values in TABLE_1.items()}
    scene = SCENE.model_copy(update={"resection": "none"})
    report = build_atlas(PATIENT, scene, tmp_path / "soft.h5", materials=soft, solver="scipy")
    beyond = report.diagnostics["inverted_elements"] > 0
    assert beyond.any()
    np.testing.assert_array_equal(beyond, report.diagnostics["smallest_det_f"] <= 0.0)
    (warning,) = report.warnings
    assert f"gravity, with tumour: in {beyond.sum()} of 12 entries" in warning
    monkeypatch.setenv("COLUMNS", "400")
    assert warning in shown_text(tmp_path / "soft.h5")


def test_faults_are_found_before_the_work(tmp_path):
    stages = []
    with pytest.raises(InputError, match="tolerance_mm"):
        build_atlas(
            *(PATIENT, SCENE.model_copy(update={"tolerance_mm": 1.0}), tmp_path / "a.h5"),
            progress=lambda *step: stages.append(step),
        )
    with pytest.raises(InputError, match="its folder does not exist"):
        build_atlas(PATIENT, SCENE, tmp_path / "absent" / "a.h5", progress=lambda *step: stages.append(step))
    whole = np.full_like(PATIENT.tissue, Tissue.WHITE)
    for scene, words in (
        (SCENE, "no tumour to resect"),
        (MIXED.model_copy(update={"resection": "none"}), "no tumour whose surroundings could swell"),
    ):
        with pytest.raises(InputError, match=words):
            build_atlas(replace(PATIENT, tissue=whole), scene, tmp_path / "a.h5", progress=lambda *step: stages.append(step))
    assert stages == []
    assert list(tmp_path.iterdir()) == []


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


def shown_text(path):
    """What `--show` prints."""
    shown = run("--show", path)
    assert shown.exit_code == 0, shown.output
    return shown.output


def stop(*_, **__):
    raise KeyboardInterrupt


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
    page = tmp_path / "conditions.png"
    result = run(scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5", "--solver", "scipy", "--page", page)
    assert result.exit_code == 0, result.output
    assert page.read_bytes().startswith(b"\x89PNG")
    assert "2 entries by scipy" in result.output.replace("\n", " ")
    shown = shown_text(tmp_path / "atlas.h5")
    assert PATIENT.patient_id[:20] in shown
    assert "with tumour" in shown


def test_show_describes_mechanisms_model_and_figures(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    model = Model(skull="contact")
    report = build_atlas(PATIENT, MIXED.model_copy(update={"model": model}), tmp_path / "a.h5", solver="scipy")
    shown = shown_text(tmp_path / "a.h5")
    for words in (
        "elements P1, time steady, skull contact",
        "scipy",
        "with tumour, tumour resected",
        "6 entries; fluid levels: 0.40",
        "12 entries; capillary pressure -3633 Pa, permeability from k_c1 (0) to k_c3 (1): 0.00, 1.00",
        "12 entries; capillary pressure, of 3633 Pa: 0.50, 1.00",
        f"{report.residual:.1e}",
        "smallest det F",
        "normals closed",
        f"{1e3 * report.largest_shift.max():.1f} mm",
    ):
        assert words in shown


@pytest.mark.usefixtures("_patient_at_hand")
def test_command_stopped_by_ctrl_c_before_anything_is_solved_leaves_nothing(tmp_path, scene_path, monkeypatch):
    monkeypatch.setattr("brainshift_ros.atlas.problem.assemble_system", stop)
    result = run(scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5")
    assert result.exit_code == 130
    assert "nothing was written" in result.output
    assert [p.name for p in tmp_path.iterdir()] == ["scene.yaml"]


@pytest.mark.usefixtures("_patient_at_hand")
def test_command_stopped_by_ctrl_c_resumes(tmp_path, scene_path, monkeypatch):
    arguments = (scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5", "--solver", "scipy")
    (tmp_path / "atlas.h5").write_text("the old one")
    with monkeypatch.context() as patched:
        patched.setattr("brainshift_ros.atlas.build.write_atlas", stop)
        result = run(*arguments)
    assert result.exit_code == 130
    assert "the same command resumes" in result.output
    assert (tmp_path / "atlas.h5").read_text() == "the old one"
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    assert "2 entries by scipy, 2 of them kept from an interrupted build" in result.output.replace("\n", " ")
    assert {p.name for p in tmp_path.iterdir()} == {"scene.yaml", "atlas.h5"}


@pytest.mark.usefixtures("_patient_at_hand")
def test_fresh_command_starts_anew(tmp_path, scene_path, monkeypatch):
    arguments = (scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5", "--solver", "scipy")
    with monkeypatch.context() as patched:
        patched.setattr("brainshift_ros.atlas.build.write_atlas", stop)
        run(*arguments)
    result = run(*arguments, "--fresh")
    assert result.exit_code == 0, result.output
    assert "kept" not in result.output


@pytest.mark.usefixtures("_patient_at_hand")
def test_command_names_the_patient_whose_mesh_cannot_be_solved(tmp_path, scene_path, monkeypatch):
    monkeypatch.setattr("brainshift_ros.solvers.direct.RESIDUAL_LIMIT", 0.0)
    result = run(scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5")
    assert isinstance(result.exception, InputError)
    assert result.exception.source == "patient.h5"
    assert "residual" in result.exception.problem


@pytest.mark.usefixtures("_patient_at_hand")
def test_command_names_the_scene_file_that_asks_too_much(tmp_path, scene_path):
    scene_path.write_text(scene_path.read_text() + "tolerance_mm: 1.0\n")
    result = run(scene_path, "--patient", "patient.h5", "-o", tmp_path / "atlas.h5")
    assert isinstance(result.exception, InputError)
    assert result.exception.source == str(scene_path)


def test_command_without_arguments_says_what_it_needs():
    result = run()
    assert result.exit_code == 2
    assert "--patient" in result.output

"""A person's septa from a file: its three kinds, and one clear error for each thing that can be wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.resources import resource
from brainshift_ros.septa.files import read_septa, write_septa
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surfacing import face_areas, vertex_normals

EXAMPLE = resource("config/septa_example.yaml")
FULL = resource("config/template_mni152.yaml")


@pytest.fixture(scope="module")
def septa() -> tuple[Septum, ...]:
    return read_septa(EXAMPLE, 5.0)


def mapped(content: Any, point_of: Any) -> Any:
    """Apply a function to every point (three numbers) of nested YAML content; a `normal` stays."""
    if isinstance(content, dict):
        return {key: value if key == "normal" else mapped(value, point_of) for key, value in content.items()}
    if isinstance(content, list):
        if len(content) == 3 and all(isinstance(value, int | float) for value in content):
            return [float(value) for value in point_of(np.asarray(content, dtype=float))]
        return [mapped(value, point_of) for value in content]
    return content


def example() -> dict[str, Any]:
    return yaml.safe_load(EXAMPLE.read_text())


def written(folder: Path, content: Any) -> Path:
    path = folder / "septa.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_few_points_come_close_to_the_full_landmarks(septa: tuple[Septum, ...]) -> None:
    full = read_septa(FULL, 5.0)
    assert [s.name for s in septa] == [s.name for s in full] == ["falx", "tentorium", "tentorium"]
    for few, many in zip(septa, full, strict=True):
        # the attached edges are drawn on the skull here, outside it there
        vertices = np.delete(many.surface.vertices, many.attached, axis=0)
        distance_mm = 1e3 * closest_points(few.surface, vertices).distance
        assert distance_mm.mean() < 1.0
        assert np.percentile(distance_mm, 95) < 2.5


@pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
def test_sheets_round_trip(septa: tuple[Septum, ...], tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"septa{suffix}"
    write_septa(path, septa)
    # for other software: mm, RAS, one cell value a sheet
    mesh = meshio.read(path)
    assert np.ptp(mesh.points[:, 1]) == pytest.approx(1e3 * np.ptp(septa[0].surface.vertices[:, 1]))
    assert sorted(set(mesh.cell_data["septum"][0])) == [1, 2, 3]
    for before, after in zip(septa, read_septa(path, 5.0), strict=True):
        assert after.name == before.name
        assert face_areas(after.surface).sum() == pytest.approx(face_areas(before.surface).sum())
        edge = before.surface.vertices[before.attached]
        np.testing.assert_allclose(after.surface.vertices[after.attached], edge, atol=1e-8)


def test_sheets_turned_by_other_software_are_turned_back(septa: tuple[Septum, ...], tmp_path: Path) -> None:
    path = tmp_path / "septa.vtu"
    write_septa(path, septa)
    mesh = meshio.read(path)
    faces = mesh.cells_dict["triangle"].copy()
    turned = np.random.default_rng(0).random(len(faces)) < 0.5
    faces[turned] = faces[turned][:, ::-1]
    meshio.write(path, meshio.Mesh(mesh.points, [("triangle", faces)], cell_data=mesh.cell_data))
    for before, after in zip(septa, read_septa(path, 5.0), strict=True):
        axis = 0 if before.name == "falx" else 2
        assert (vertex_normals(after.surface.vertices, after.surface.faces)[:, axis] > 0.0).all()
        assert len(after.attached) == 0


@pytest.mark.parametrize(
    ("point_of", "message"),
    [
        (lambda p: p * [-1, -1, 1], r"other side of the mid-sagittal|LPS"),
        (lambda p: p * [-1, 1, 1], r"other side of the mid-sagittal|mirrored"),
        (lambda p: p * [1, 1, -1], "above the falx"),
        (lambda p: p * [1, -1, 1], "in front of the falx"),
        (lambda p: p * 1e-3, r"measures 0\.\d+ mm"),
        (lambda p: p * 10.0, r"measures \S+e\+03 mm"),
    ],
    ids=["LPS", "mirrored", "upside down", "back to front", "metres", "tenths of a millimetre"],
)
def test_wrong_frames_and_units_are_refused(tmp_path: Path, point_of: Any, message: str) -> None:
    content = mapped(example(), point_of)
    with pytest.raises(InputError, match=message) as caught:
        read_septa(written(tmp_path, content), 5.0)
    assert "septa.yaml" in str(caught.value)


@pytest.mark.parametrize(("flip", "message"), [((-1, -1, 1), "LPS"), ((-1, 1, 1), "mirrored"), ((1, 1, -1), "above the falx")])
def test_sheets_and_full_landmarks_in_a_wrong_frame_are_refused(
    septa: tuple[Septum, ...], tmp_path: Path, flip: tuple[int, int, int], message: str
) -> None:
    path = tmp_path / "septa.vtk"
    write_septa(path, septa)
    mesh = meshio.read(path)
    mesh.points = mesh.points * flip
    meshio.write(path, mesh)
    with pytest.raises(InputError, match=message):
        read_septa(path, 5.0)
    content = yaml.safe_load(FULL.read_text())["septa"]
    left = content["tentorium"]["left"]
    content["tentorium"]["right"] = mapped(left, lambda p: p * [-1, 1, 1])
    with pytest.raises(InputError, match=message):
        read_septa(written(tmp_path, {"septa": mapped(content, lambda p: p * flip)}), 5.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s["falx"].update(outer_edge=s["falx"]["outer_edge"][:2]), r"falx\.outer_edge.*at least 3"),
        (lambda s: s["tentorium"]["left"].update(plane=s["tentorium"]["left"]["plane"][:2]), r"tentorium\.left\.plane"),
        (lambda s: s["tentorium"]["left"].update(targets=[[-10, -56, -5]]), r"targets.*at least 3"),
        (lambda s: s["tentorium"]["left"].update(plane=[[-5, -60, 0], [-15, -60, 0], [-25, -60, 0]]), "lie on a line"),
        (lambda s: s["midsagittal_plane"].update(normal=[0, 0, 0]), "normal is zero"),
        (lambda s: s["falx"]["outer_edge"].insert(3, [14, -60, 70]), "14 mm off the mid-sagittal plane"),
        (lambda s: s["falx"]["outer_edge"].insert(3, s["falx"]["outer_edge"][2]), "twice in a row"),
        (lambda s: s["falx"]["outer_edge"].insert(2, s["falx"]["outer_edge"].pop(5)), "crosses itself"),
        (lambda s: s["tentorium"]["left"]["outline"].reverse(), "crosses itself"),
        (lambda s: s.pop("straight_sinus"), r"straight_sinus: Field required"),
        (lambda s: s["falx"].update(edge=[]), r"falx\.edge"),
    ],
)
def test_faults_of_a_sketch_are_named(tmp_path: Path, change: Any, message: str) -> None:
    content = example()
    change(content["septa_sketch"])
    with pytest.raises(InputError, match=message):
        read_septa(written(tmp_path, content), 5.0)


def test_a_file_of_both_or_no_style_is_refused(tmp_path: Path) -> None:
    both = example() | {"septa": yaml.safe_load(FULL.read_text())["septa"]}
    with pytest.raises(InputError, match="both `septa` and `septa_sketch`"):
        read_septa(written(tmp_path, both), 5.0)
    with pytest.raises(InputError, match="septa: Field required"):
        read_septa(written(tmp_path, {"landmarks": 3}), 5.0)


def test_what_is_no_sheet_mesh_is_refused(septa: tuple[Septum, ...], tmp_path: Path) -> None:
    path = tmp_path / "septa.vtu"
    with pytest.raises(InputError, match="no such file"):
        read_septa(path, 5.0)
    path.write_text("falx")
    with pytest.raises(InputError, match="cannot be read as a mesh"):
        read_septa(path, 5.0)
    points = np.array([[0.0, 0, 0], [50, 0, 0], [0, 50, 0], [0, 0, 50]])
    meshio.write(path, meshio.Mesh(points, [("tetra", np.array([[0, 1, 2, 3]]))]))
    with pytest.raises(InputError, match="holds 0 triangles"):
        read_septa(path, 5.0)
    meshio.write(path, meshio.Mesh(points, [("triangle", np.array([[0, 1, 2]]))]))
    with pytest.raises(InputError, match="cell data `septum`"):
        read_septa(path, 5.0)
    write_septa(path, septa[:2])
    with pytest.raises(InputError, match="no triangles of the right tentorium"):
        read_septa(path, 5.0)
    with pytest.raises(InputError, match=r"does not end in \.vtu or \.vtk"):
        write_septa(tmp_path / "septa.stl", septa)


@settings(max_examples=15, deadline=None)
@given(
    shift=st.tuples(*3 * [st.floats(-40.0, 40.0)]),
    tilt=st.tuples(*3 * [st.floats(-0.2, 0.2)]),
    scale=st.floats(0.85, 1.15),
)
def test_another_head_in_the_scanner_gives_the_same_sheets_there(
    septa: tuple[Septum, ...],
    tmp_path_factory: pytest.TempPathFactory,
    shift: tuple[float, ...],
    tilt: tuple[float, ...],
    scale: float,
) -> None:
    """Sheets move with their landmarks, whatever the head's place, tilt (to 20 degrees) and size."""
    turn = Rotation.from_rotvec(tilt)
    content = mapped(example(), lambda p: scale * turn.apply(p) + shift)
    plane = content["septa_sketch"]["midsagittal_plane"]
    plane["normal"] = turn.apply(plane["normal"]).tolist()
    path = written(tmp_path_factory.mktemp("moved"), content)
    for there, here in zip(read_septa(path, 5.0), septa, strict=True):
        expected = 1e-3 * (scale * turn.apply(1e3 * here.surface.vertices) + shift)
        distance = closest_points(there.surface, expected).distance
        # the triangles differ, the surfaces do not but for their flat facets
        assert 1e3 * distance.mean() < 0.3
        assert face_areas(there.surface).sum() == pytest.approx(scale**2 * face_areas(here.surface).sum(), rel=0.02)

"""`brainshift track` as a person calls it: a recorded case gives points, a dense field and a page; faults are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from ros_cases import CRANIOTOMY_M, brain_patient, brain_scans, brain_shift

from brainshift_ros import graph
from brainshift_ros.bags import BagWriter
from brainshift_ros.cli.track import command
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.inverse.points_csv import read_homologous_points
from brainshift_ros.mesh.patient_file import write_patient
from brainshift_ros.pictures.scan import pixels_of
from brainshift_ros.simulation.scanner import Scanner
from brainshift_ros.units import m_to_mm
from brainshift_ros.wire.scan import encode_scan


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Folder with a patient and bags of the same scans: with a pose and without, alone, and on a wrong scale."""
    folder = tmp_path_factory.mktemp("track")
    first, later, T_patient_tracker, T_start = brain_scans(scanner=Scanner(width=320, height=240))
    write_patient(folder / "patient.h5", brain_patient())
    scene = {
        "gravity": {"direction": [0.0, -1.0, 0.0]},
        "craniotomy": {"center_mm": m_to_mm(CRANIOTOMY_M).tolist(), "diameter_mm": 30.0},
    }
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    with BagWriter(folder / "whole") as bag:
        bag.add_scan(first)
        bag.add_initial_pose(T_start, first.stamp_ns + 1)
        spoilt = encode_scan(replace(later, stamp_ns=first.stamp_ns + 2)) | {"header": {"frame_id": "map"}}
        bag.add(graph.LRS_POINTS, first.stamp_ns + 2, spoilt)
        bag.add_scan(later)
        bag.add_scan(later)
    with BagWriter(folder / "unposed.mcap") as bag:
        bag.add_scan(first)
        bag.add_scan(later)
    with BagWriter(folder / "single.mcap") as bag:
        bag.add_initial_pose(T_start, first.stamp_ns)
        bag.add_scan(first)
    with BagWriter(folder / "shrunk.mcap") as bag:
        bag.add_initial_pose(T_start, first.stamp_ns)
        bag.add_scan(replace(first, points=first.points * np.float32(0.6)))
    return folder, T_patient_tracker, first, later


def track(folder, bag, *arguments):
    given = [str(folder / bag), "--patient", str(folder / "patient.h5"), *map(str, arguments)]
    done = CliRunner().invoke(command, given, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def errors_mm(points):
    return m_to_mm(np.linalg.norm(points.displacements - brain_shift(points.points), axis=1))


def test_a_recorded_case_gives_points_dense_field_and_page(case, tmp_path):
    folder = case[0]
    output = track(folder, "whole", "-o", tmp_path / "points.csv", "--dense", 3, "--page", tmp_path / "page.png")
    assert np.median(errors_mm(read_homologous_points(tmp_path / "points.csv"))) < 0.8
    assert np.median(errors_mm(read_homologous_points(tmp_path / "points_dense.csv"))) < 1.0
    assert (tmp_path / "page.png").stat().st_size > 50_000
    lines = output.splitlines()
    assert lines[0].startswith("scan 1: registered; from pose; RMS ")
    assert "scan 2: passed over: lrs/points: frame is 'map', expected 'tracker'" in lines[1]
    assert any(line.startswith("scan 3: tracked; ") and "homologous points" in line for line in lines)
    assert "scan 4: the same scan came twice in a row" in output


def test_without_a_pose_it_searches_near_the_craniotomy_and_guides_do_the_matching(case, tmp_path):
    folder, T_patient_tracker, first, later = case
    at = transform_points(invert_rigid(T_patient_tracker), CRANIOTOMY_M + 0.012 * np.array([[1, 0, 0], [-1, 1, 0], [0, -1, 0]]))
    nearest = [np.unravel_index(np.nanargmin(np.linalg.norm(first.points - p, axis=-1)), first.seen.shape) for p in at]
    on_cortex = transform_points(T_patient_tracker, np.array([first.points[pixel] for pixel in nearest]))
    moved = transform_points(invert_rigid(T_patient_tracker), on_cortex + brain_shift(on_cortex))
    pairs = np.hstack([np.array(nearest), pixels_of(later, moved)[:, ::-1]]).tolist()
    (tmp_path / "guides.yaml").write_text(yaml.safe_dump({"pairs_px": [[float(value) for value in pair] for pair in pairs]}))
    output = track(
        folder, "unposed.mcap", "-o", tmp_path / "p.csv", "--scene", folder / "scene.yaml", "--guides", tmp_path / "guides.yaml"
    )
    assert "scan 1: registered; from search; " in output
    assert "guides: tracked by guides; " in output
    assert np.median(errors_mm(read_homologous_points(tmp_path / "p.csv"))) < 0.8


@pytest.mark.parametrize(
    ("bag", "options", "fault"),
    [
        ("none", (), "no such bag"),
        ("single.mcap", (), "no usable scan came after the one that was registered"),
        ("shrunk.mcap", (), "no scan of it could be registered (registration refused: "),
        ("whole", ("--guides", "none.yaml"), "none.yaml: no such file"),
        ("whole", ("--fiducials", "none.yaml"), "none.yaml: no such file"),
        ("whole", ("--page", "page.jpg"), "its name does not end in .png"),
        ("whole", ("--patient", "none.h5"), "none.h5: no such file"),
        ("whole", ("-o", "nowhere/points.csv"), "its folder does not exist"),
    ],
)
def test_faults_are_named_and_nothing_is_written(case, tmp_path, bag, options, fault):
    with pytest.raises(InputError) as caught:
        track(case[0], bag, "-o", tmp_path / "points.csv", *options)
    assert fault in str(caught.value)
    assert list(tmp_path.iterdir()) == []

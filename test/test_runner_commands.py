"""`brainshift run`, `replay`, `record` as a person calls them."""

from __future__ import annotations

import signal
import subprocess
import sys

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from ros_cases import box_mesh, write_box_atlas

from brainshift_ros import graph
from brainshift_ros.bags import BagWriter, read_bag
from brainshift_ros.cli.run import command as run_command
from brainshift_ros.errors import InputError
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.patient_file import patient_digest, write_patient
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.resources import resource
from brainshift_ros.runner import ros_environment
from brainshift_ros.surface.surface import Surface

BRAINSHIFT = [sys.executable, "-m", "brainshift_ros.cli.main"]


@pytest.fixture(autouse=True)
def logs_stay_here(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("logs")))


def box_patient():
    mesh = box_mesh()
    cortex = Surface(mesh.nodes, mesh.facets["skull"])
    image = ImageReference("box", "0" * 64, (2, 2, 2), np.eye(4))
    tissue = np.ones(len(mesh.elements), dtype=np.uint8)
    return PatientModel(mesh, tissue, cortex, image, {"inverted": 0.0}, (), patient_digest(mesh, tissue, cortex, image))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    patient = box_patient()
    write_patient(folder / "patient.h5", patient)
    write_box_atlas(folder / "atlas.h5", patient_id=patient.patient_id)
    write_box_atlas(folder / "foreign.h5")
    return folder


def refused(*arguments):
    with pytest.raises(InputError) as caught:
        CliRunner().invoke(run_command, [str(item) for item in arguments], catch_exceptions=False)
    return str(caught.value)


def test_run_refuses_wrong_files_before_it_starts_anything(files, tmp_path):
    patient, atlas = files / "patient.h5", files / "atlas.h5"
    assert "no such file" in refused("--atlas", files / "none.h5", "--patient", patient)
    assert "is not a brainshift atlas file" in refused("--atlas", patient, "--patient", patient)
    assert "was built for patient b0b0b0b0b0b0" in refused("--atlas", files / "foreign.h5", "--patient", patient)
    assert "no such file" in refused("--atlas", atlas, "--patient", patient, "--image", tmp_path / "none.nii.gz")
    for content, fault in (("- 1", "has no `ros__parameters`"), ("a: [", "is not YAML"), ("/**: {arrows: 3}", "has no `ros__")):
        (tmp_path / "mine.yaml").write_text(content)
        assert fault in refused("--atlas", atlas, "--patient", patient, "--params", tmp_path / "mine.yaml")


def test_the_shipped_parameter_file_passes_the_check_and_names_no_node():
    """A section with a node's name would beat a launch file's inline parameters."""
    content = yaml.safe_load(resource("config/nodes.yaml").read_text(encoding="utf-8"))
    assert list(content) == ["/**"]
    assert content["/**"]["ros__parameters"]


@pytest.mark.integration
def test_run_starts_the_graph_and_ends_it_cleanly_on_sigterm(files):
    arguments = ["run", "--atlas", str(files / "atlas.h5"), "--patient", str(files / "patient.h5"), "--domain-id", "21"]
    process = subprocess.Popen(
        [*BRAINSHIFT, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=ros_environment(21)
    )
    # Enough heartbeats that each of the four nodes has spoken, in whatever order they are discovered.
    goals = ("--until", "diagnostics:40", "--until", "atlas/info")
    listed = tool("record", str(files / "heard.mcap"), *goals, "--timeout", "60", domain=21)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=30)
    assert listed.returncode == 0, listed.stderr
    assert process.returncode == 0, output
    assert "Traceback" not in output
    heard = {status.name for item in read_bag(files / "heard.mcap", [graph.DIAGNOSTICS]) for status in item.message().status}
    assert heard <= {node.name for node in graph.NODES}
    assert "atlas_loader" in heard


def tool(*arguments, domain=22):
    return subprocess.run([*BRAINSHIFT, *arguments], env=ros_environment(domain), capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["replay", "none"], "brainshift: none: no such bag; give a rosbag2 folder or an .mcap file\n"),
        (["record", "nowhere/bag"], "brainshift: nowhere/bag: its folder does not exist"),
        (["record", "bag", "--topic", "lrs/point"], "brainshift: topic: the graph has no lrs/point; choose from atlas/info"),
    ],
)
@pytest.mark.integration
def test_tools_say_what_is_wrong_in_one_line(arguments, fault):
    done = tool(*arguments)
    assert done.returncode == 2
    assert done.stderr.startswith(fault)
    assert done.stderr.count("\n") == 1


@pytest.mark.integration
def test_replay_says_when_nobody_listens(tmp_path):
    with BagWriter(tmp_path / "poses") as bag:
        bag.add_initial_pose(np.eye(4), 1)
    done = tool("replay", str(tmp_path / "poses"), "--wait", "0.2")
    assert done.returncode == 0
    assert "fewer than 1 subscribers of lrs/initial_pose after 0.2 s" in done.stderr
    assert "published 1 messages" in done.stdout
    nothing = tool("replay", str(tmp_path / "poses"), "--topic", "lrs/points")
    assert nothing.returncode == 2
    assert "holds no message on lrs/points" in nothing.stderr


@pytest.mark.integration
def test_a_recording_that_lacks_its_goal_ends_with_status_3(tmp_path):
    done = tool("record", str(tmp_path / "bag"), "--topic", "lrs/points", "--until", "lrs/points:2", "--timeout", "0.5")
    assert done.returncode == 3
    assert "without lrs/points (0 of 2)" in done.stderr
    assert read_bag(tmp_path / "bag") == []


@pytest.mark.integration
def test_large_clouds_are_neither_lost_nor_changed_on_their_way(tmp_path):
    """Ten full-size scans as fast as they go, from replay to record, on the shipped transport profile."""
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / "clouds") as bag:
        for number in range(10):
            points = rng.normal(0.0, 0.1, (480, 640, 3)).astype(np.float32)
            scan = OrganisedScan(points, rng.integers(0, 256, (480, 640, 3), dtype=np.uint8), "tracker", number + 1)
            bag.add_scan(scan)
    arguments = ["record", str(tmp_path / "heard"), "--until", "lrs/points:10", "--timeout", "60"]
    recorder = subprocess.Popen([*BRAINSHIFT, *arguments], env=ros_environment(23), stdout=subprocess.PIPE, text=True)
    try:
        assert "recording" in recorder.stdout.readline()
        assert tool("replay", str(tmp_path / "clouds"), domain=23).returncode == 0
        assert recorder.wait(60) == 0
    finally:
        recorder.kill()
        recorder.stdout.close()
    sent, heard = (read_bag(tmp_path / name, [graph.LRS_POINTS]) for name in ("clouds", "heard"))
    assert [item.cdr for item in heard] == [item.cdr for item in sent]


@pytest.mark.integration
def test_a_recording_is_complete_when_it_is_stopped(tmp_path):
    arguments = [*BRAINSHIFT, "record", str(tmp_path / "bag.mcap"), "--topic", "atlas/info"]
    recorder = subprocess.Popen(arguments, env=ros_environment(24), stdout=subprocess.PIPE, text=True)
    assert "recording 1 topics" in recorder.stdout.readline()
    assert not (tmp_path / "bag.mcap").exists(), "it appears under its name when it is complete"
    recorder.send_signal(signal.SIGTERM)
    output, _ = recorder.communicate(timeout=30)
    assert recorder.returncode == 0
    assert "recorded 0 messages" in output
    assert [item.name for item in tmp_path.iterdir()] == ["bag.mcap"]

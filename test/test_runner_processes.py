"""The runner: environment, parameters, output, ends that are clean and ends that are not. No ROS here."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from brainshift_ros import graph, runner
from brainshift_ros.resources import resource
from brainshift_ros.runner import Graph, Process, Respawner, case_parameters, ros_environment

STUBBORN = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True); time.sleep(60)"
POLITE = """
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
print(' '.join(sys.argv[1:]), flush=True)
time.sleep(60)
"""


@pytest.fixture
def programs(tmp_path, monkeypatch):
    """Modules that stand in for nodes: name -> a graph of them."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def declare(**sources):
        for name, source in sources.items():
            (tmp_path / f"{name}_program.py").write_text(source)
        nodes = tuple(graph.Node(name, f"{name}_program", (), ()) for name in sources)
        monkeypatch.setattr(runner.graph, "NODES", nodes)

    return declare


def until(condition):
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_environment_sets_the_transport_and_keeps_what_the_user_chose(monkeypatch):
    for name in ("FASTDDS_DEFAULT_PROFILES_FILE", "AMENT_PREFIX_PATH", "ROS_DOMAIN_ID"):
        monkeypatch.delenv(name, raising=False)
    environment = ros_environment()
    assert environment["FASTDDS_DEFAULT_PROFILES_FILE"] == str(resource("config/fastdds_large_clouds.xml"))
    assert environment["AMENT_PREFIX_PATH"] == sys.prefix
    assert "ROS_DOMAIN_ID" not in environment
    monkeypatch.setenv("FASTDDS_DEFAULT_PROFILES_FILE", "/mine.xml")
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/kilted")
    alone = ros_environment(7)
    assert alone["FASTDDS_DEFAULT_PROFILES_FILE"] == "/mine.xml"
    assert alone["AMENT_PREFIX_PATH"] == "/opt/ros/kilted"
    assert (alone["ROS_DOMAIN_ID"], alone["ROS_AUTOMATIC_DISCOVERY_RANGE"]) == ("7", "LOCALHOST")


def test_output_comes_line_by_line_under_the_name():
    lines = []
    process = Process("speaker", ["platform"], os.environ, lambda name, line: lines.append((name, line)))
    assert process.wait(20) == 0
    assert len(lines) == 1
    assert lines[0][0] == "speaker"


def test_nodes_get_files_first_and_parameters_by_their_name(programs, tmp_path):
    programs(lrs=POLITE)
    lines = []
    mine = tmp_path / "mine.yaml"
    with Graph(
        {"lrs": {"patient_file": "123", "n": 2}}, params_files=[mine], sink=lambda _, line: lines.append(line)
    ) as running:
        until(lambda: lines)
        shipped = resource("config/nodes.yaml")
        assert lines[0] == (
            f'--ros-args --params-file {shipped} --params-file {mine} -p lrs:patient_file:="123" -p lrs:n:=2'
        ), "a path that looks like a number stays a string"
        assert running.ended() == {}
    assert running.ended() == {"lrs": 0}


def test_a_node_that_ignores_sigterm_is_killed(programs, monkeypatch):
    programs(polite=POLITE, stubborn=STUBBORN)
    monkeypatch.setattr(runner, "STOP_LIMIT_S", 0.5)
    lines = []
    with Graph({}, sink=lambda name, line: lines.append(name)) as running:
        until(lambda: len(lines) == 2)
    assert running.ended() == {"polite": 0, "stubborn": -9}


def test_all_are_stopped_when_one_cannot_be_started(programs, monkeypatch):
    programs(first=POLITE, second=POLITE)
    started = []
    real = subprocess.Popen

    def fails_the_second_time(*arguments, **options):
        if started:
            raise OSError("no more processes")
        started.append(real(*arguments, **options))
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", fails_the_second_time)
    with pytest.raises(OSError, match="no more processes"):
        Graph({}, sink=lambda *_: None).__enter__()
    assert started[0].poll() is not None


def test_a_node_that_ends_is_started_again_but_not_for_ever(programs):
    programs(fragile="print('something is missing')\nraise SystemExit(3)")
    said = []
    with Graph({}, sink=lambda *_: None) as running:
        respawner = Respawner(running, said.append)
        for _ in range(2):
            assert running.processes["fragile"].wait(20) == 3
            assert respawner.look_after()
        running.processes["fragile"].wait(20)
        assert not respawner.look_after()
    assert said[0] == "node fragile ended (status 3), starting it again; its last line: something is missing"
    assert said[2] == "node fragile ended 3 times within 30 s (status 3); its last line: something is missing"


def test_paths_of_a_case_become_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parameters = case_parameters("atlas.h5", "patient.h5", image_file="t1.nii.gz", output_dir="out")
    assert parameters == {
        "atlas_loader": {"atlas_file": str(tmp_path / "atlas.h5")},
        "lrs": {"patient_file": str(tmp_path / "patient.h5")},
        "inverse": {"image_file": str(tmp_path / "t1.nii.gz"), "output_dir": str(tmp_path / "out")},
    }

"""How nodes begin and what they say where they cannot: signals during the imports, packages that are missing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest
from click.testing import CliRunner

from brainshift_ros import graph, runner
from brainshift_ros.cli.replay import command as replay_command
from brainshift_ros.errors import InputError
from brainshift_ros.runner import Graph

pytestmark = pytest.mark.integration

MODULES = [node.module for node in graph.NODES]


def process(module, folder):
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", module], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("module", MODULES)
def test_a_node_that_is_stopped_while_it_imports_ends_quietly(module, number, tmp_path):
    """NumPy, which every node imports, is replaced by a module that never finishes."""
    (tmp_path / "numpy.py").write_text("import time\nprint('importing', flush=True)\ntime.sleep(60)\n")
    with process(module, tmp_path) as node:
        assert node.stdout.readline() == "importing\n"
        node.send_signal(number)
        output, _ = node.communicate(timeout=20)
    assert (node.returncode, output) == (0, "")


@pytest.mark.parametrize("module", MODULES)
def test_a_node_without_ros_says_so_in_one_line(module, tmp_path):
    (tmp_path / "rclpy.py").write_text("raise ModuleNotFoundError(\"No module named 'rclpy'\", name='rclpy')\n")
    with process(module, tmp_path) as node:
        output, _ = node.communicate(timeout=20)
    assert node.returncode == 2
    assert output.startswith(f"brainshift: {module}_node: cannot be imported: No module named 'rclpy'; install ")
    assert output.count("\n") == 1


@pytest.fixture
def no_ros(monkeypatch):
    lacking = {"rclpy", "sensor_msgs"}
    real = runner.find_spec
    monkeypatch.setattr(runner, "find_spec", lambda name: None if name in lacking else real(name))


def test_commands_without_ros_name_what_is_missing(no_ros, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "execve", lambda *_: pytest.fail("the tool was started all the same"))
    with pytest.raises(InputError, match=r"ROS 2: rclpy, sensor_msgs not found by .*; run `pip install -r") as caught:
        CliRunner().invoke(replay_command, ["bag"], catch_exceptions=False)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="rclpy, sensor_msgs not found"):
        Graph({})


@pytest.mark.parametrize("arguments", [["replay", "bag"], ["record", "bag"]])
def test_the_command_line_without_ros_ends_with_one_line(arguments, tmp_path):
    code = f"import sys; sys.argv = {json.dumps(['brainshift', *arguments])}; sys.modules['rclpy'] = None; "
    code += "from brainshift_ros.cli.main import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("brainshift: ROS 2: rclpy not found by ")
    assert done.stderr.count("\n") == 1

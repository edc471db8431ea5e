"""`colcon build` lays the package out where `ros2 run` and `ros2 launch` look, and what it installs starts."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import brainshift_ros
from brainshift_ros import graph

pytestmark = pytest.mark.integration

ROOT = Path(brainshift_ros.__file__).parent.parent
SHIPPED = ["package.xml", "setup.py", "setup.cfg", "pyproject.toml", "resource", "config", "launch_scripts", "requirements"]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """`install/brainshift_ros` of a workspace that holds a copy of the package."""
    workspace = tmp_path_factory.mktemp("workspace")
    source = workspace / "src" / "brainshift_ros"
    source.mkdir(parents=True)
    for name in [*SHIPPED, "brainshift_ros"]:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, source / name)
    colcon = Path(sys.executable).with_name("colcon")
    environment = os.environ | {
        "PATH": f"{colcon.parent}{os.pathsep}{os.environ['PATH']}",
        "COLCON_HOME": str(workspace / "home"),
    }
    built = subprocess.run(
        [colcon, "build", "--event-handlers", "console_direct+"],
        cwd=workspace,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace / "install" / "brainshift_ros"


def test_executables_lie_where_ros2_run_looks(installed):
    folder = installed / "lib" / "brainshift_ros"
    names = {path.name for path in folder.iterdir()}
    assert names == {*(node.name for node in graph.NODES), "brainshift"}
    assert all(os.access(path, os.X_OK) for path in folder.iterdir())


def test_the_ament_index_knows_the_package(installed):
    assert (installed / "share" / "ament_index" / "resource_index" / "packages" / "brainshift_ros").is_file()


def test_share_holds_what_ros2_launch_and_the_nodes_look_for(installed):
    share = installed / "share" / "brainshift_ros"
    for folder in ("config", "launch_scripts"):
        shipped = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        assert {path.name for path in (share / folder).iterdir()} == shipped
    assert (share / "package.xml").is_file()


def test_data_files_of_the_package_are_installed(installed):
    """Schemas and landmarks that the code reads must not stay behind in the checkout."""
    found = {path.name for path in installed.rglob("*") if "site-packages" in path.parts}
    needed = {path.name for path in (ROOT / "brainshift_ros").rglob("*") if path.suffix in (".json", ".yaml", ".py", ".typed")}
    assert needed <= found


def test_an_installed_executable_starts_and_finds_its_shipped_files(installed, tmp_path):
    site = next(path for path in installed.rglob("site-packages") if path.is_dir())
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith(("AMENT", "FASTDDS"))},
        "PYTHONPATH": str(site),
        "AMENT_PREFIX_PATH": str(installed),
    }
    version = subprocess.run(
        [installed / "lib" / "brainshift_ros" / "brainshift", "--version"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert brainshift_ros.__version__ in version.stdout, version.stderr
    program = """
import brainshift_ros
from brainshift_ros.resources import resource
print(brainshift_ros.__file__, resource('config/nodes.yaml'))
"""
    found = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    module, shipped = found.stdout.split()
    assert module.startswith(str(site))
    assert shipped == str(installed / "share" / "brainshift_ros" / "config" / "nodes.yaml")

"""The launch file against stand-ins for `launch` and `launch_ros`, which are not among the wheels.

The stand-ins know only what the launch file may rely on; the real tools are an outside check, not part of this suite.
"""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import pytest

import brainshift_ros
from brainshift_ros import graph
from brainshift_ros.resources import resource
from brainshift_ros.runner import case_parameters, ros_environment

ROOT = Path(brainshift_ros.__file__).parent.parent


@dataclass
class LaunchDescription:
    entities: list


@dataclass
class DeclareLaunchArgument:
    name: str
    default_value: str | None = None
    description: str = ""


@dataclass
class SetEnvironmentVariable:
    name: str
    value: str


@dataclass(frozen=True)
class LaunchConfiguration:
    variable_name: str


@dataclass(frozen=True)
class ParameterValue:
    value: LaunchConfiguration
    value_type: type


@dataclass
class Node:
    package: str
    executable: str
    name: str
    output: str
    respawn: bool
    respawn_delay: float
    parameters: list = field(default_factory=list)


STAND_INS = {
    "launch": {"LaunchDescription": LaunchDescription},
    "launch.actions": {"DeclareLaunchArgument": DeclareLaunchArgument, "SetEnvironmentVariable": SetEnvironmentVariable},
    "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
    "launch_ros": {},
    "launch_ros.actions": {"Node": Node},
    "launch_ros.parameter_descriptions": {"ParameterValue": ParameterValue},
}


@pytest.fixture
def entities(monkeypatch):
    for name, members in STAND_INS.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("launch_file", ROOT / "launch_scripts" / "brainshift.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description().entities


def of(entities, kind):
    return [entity for entity in entities if isinstance(entity, kind)]


def test_it_starts_the_nodes_that_the_runner_starts(entities):
    started = [(node.package, node.executable, node.name) for node in of(entities, Node)]
    assert started == [("brainshift_ros", node.name, node.name) for node in graph.NODES]
    assert all(node.respawn for node in of(entities, Node))


def test_it_sets_the_same_parameters_as_the_runner(entities):
    arguments = {"atlas": "/a.h5", "patient": "/p.h5", "image": "/i.nii.gz", "output_dir": "/out"}
    arguments |= {"scene": "/s.yaml", "fiducials": "/f.yaml", "guides": "/g.yaml"}
    given = {
        node.name: {name: arguments[value.value.variable_name] for own in node.parameters[1:] for name, value in own.items()}
        for node in of(entities, Node)
    }
    files = {"scene_file": "/s.yaml", "fiducials_file": "/f.yaml", "guides_file": "/g.yaml"}
    expected = case_parameters("/a.h5", "/p.h5", image_file="/i.nii.gz", output_dir="/out", **files)
    assert {name: values for name, values in given.items() if values} == expected
    assert all(value.value_type is str for node in of(entities, Node) for own in node.parameters[1:] for value in own.values())


def test_the_parameter_file_comes_first_so_that_arguments_win(entities):
    assert all(node.parameters[0] == LaunchConfiguration("params") for node in of(entities, Node))
    declared = {item.name: item.default_value for item in of(entities, DeclareLaunchArgument)}
    assert declared == {
        "atlas": None,
        "patient": None,
        "scene": "",
        "fiducials": "",
        "guides": "",
        "image": "",
        "output_dir": "out/case",
        "params": str(resource("config/nodes.yaml")),
    }


def test_the_transport_profile_is_set_before_any_node(entities):
    variable = of(entities, SetEnvironmentVariable)[0]
    assert (variable.name, variable.value) == (
        "FASTDDS_DEFAULT_PROFILES_FILE",
        ros_environment()["FASTDDS_DEFAULT_PROFILES_FILE"],
    )
    assert entities.index(variable) < min(entities.index(node) for node in of(entities, Node))

"""Parameters of node `inverse`, and the image that it warps: what is wrong is named before anything is done with it."""

from __future__ import annotations

import subprocess
import sys

import pytest
import rclpy
import yaml
from field_cases import ellipsoid_mesh, smooth_field

from brainshift_ros.errors import InputError
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.nodes.inverse_node import InverseNode
from brainshift_ros.nodes.warping import ImageWarper
from brainshift_ros.resources import resource
from brainshift_ros.runner import ros_environment

DOMAIN = 14


@pytest.fixture
def ros(monkeypatch):
    for name, value in ros_environment(DOMAIN).items():
        monkeypatch.setenv(name, value)
    yield lambda *arguments: rclpy.init(args=["--ros-args", *arguments], domain_id=DOMAIN)
    rclpy.try_shutdown()


@pytest.mark.parametrize(
    ("setting", "fault"),
    [
        ("method:=guess", "parameter method: is 'guess'; give a value one of constrained, "),
        ("method:=3", "parameter method: .* give a value one of constrained, "),
        ("outlier_sigmas:=1.0", r"parameter outlier_sigmas: .*; give a value from 2.0 to 100.0, such as 4.5"),
        ("outlier_sigmas:=.nan", r"parameter outlier_sigmas: .*; give a value from 2.0 to 100.0"),
        ("max_outside_mm:=5", r"parameter max_outside_mm: .*INTEGER.*; give a value from 0.0 to 50.0, such as 5.0"),
        ("arrows:=0", r"parameter arrows: .*; give a value from 1 to 5000, such as 300"),
    ],
)
def test_a_wrong_parameter_is_named_with_what_is_allowed(ros, setting, fault):
    ros("-p", setting)
    with pytest.raises(InputError, match=fault):
        InverseNode()


REFUSING = """
from brainshift_ros.errors import InputError
from brainshift_ros.nodes.base import spin
def refuse():
    raise InputError("parameter method", "is 'guess'", "give another")
spin(refuse)
"""


def test_a_node_that_refuses_its_parameters_ends_with_one_line():
    ended = subprocess.run(
        [sys.executable, "-c", REFUSING], capture_output=True, text=True, check=False, env=ros_environment(DOMAIN)
    )
    assert (ended.returncode, ended.stderr) == (2, "brainshift: parameter method: is 'guess'; give another\n")


def test_the_shipped_file_holds_the_defaults():
    shipped = yaml.safe_load(resource("config/nodes.yaml").read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    usual = InverseOptions()
    for name in ("method", "max_outside_mm", "outlier_sigmas"):
        assert shipped[name] == getattr(usual, name)


FIELD = smooth_field(ellipsoid_mesh(4))


def test_warping_without_an_image_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match=r"image_file: is not set; start the node with .*`brainshift run --image`"):
        ImageWarper("", str(tmp_path)).warp(FIELD, lambda: True)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"output_dir: .*file/out cannot be made"):
        ImageWarper("t1.nii.gz", str(tmp_path / "file" / "out")).warp(FIELD, lambda: True)


def test_an_image_that_cannot_be_read_is_named_and_nothing_is_left(tmp_path):
    (tmp_path / "t1.nii.gz").write_text("a letter")
    output = tmp_path / "out"
    with pytest.raises(InputError, match=r"t1.nii.gz: could not be warped: brainshift: .*t1.nii.gz: is not a NIfTI image"):
        ImageWarper(str(tmp_path / "t1.nii.gz"), str(output)).warp(FIELD, lambda: True)
    assert not list(output.iterdir())

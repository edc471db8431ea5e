"""From scene files to atlas entries, and scenes that are refused."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.atlas.columns import entries_of, fluid_levels, groups_of
from brainshift_ros.atlas.scene import read_scene
from brainshift_ros.errors import InputError
from brainshift_ros.resources import resource

GRAVITY = "gravity: {direction: [0.0, 0.0, -1.0], cone_deg: 20, orientations: 5, fluid_levels: 3}\n"


def scene_of(tmp_path, text):
    path = tmp_path / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    return read_scene(path)


def test_demo_scene_has_thirty_orientations_with_and_without_the_tumour():
    entries = entries_of(read_scene(resource("config/scene_demo.yaml")))
    assert len(entries) == 60
    assert [entry.resected for entry in entries] == [False] * 30 + [True] * 30
    assert len({entry.gravity_direction for entry in entries}) == 30
    assert len({entry.fluid_level for entry in entries}) == 1
    np.testing.assert_allclose(entries[0].gravity_direction, [0.0, -0.9404, -0.3401], atol=1e-3)
    assert groups_of(entries)[0].columns == tuple(range(60))


@pytest.mark.parametrize(("resection", "states"), [("none", {False}), ("resected", {True}), ("both", {False, True})])
def test_resection_decides_the_element_sets(tmp_path, resection, states):
    entries = entries_of(scene_of(tmp_path, GRAVITY + f"resection: {resection}\n"))
    assert {entry.resected for entry in entries} == states
    assert len(entries) == 15 * len(states)
    assert len(set(entries)) == len(entries)


def test_fluid_levels_keep_the_lowest_whatever_their_number():
    for count in (1, 2, 3, 5):
        levels = fluid_levels(count)
        assert len(levels) == count
        assert levels[0] == fluid_levels(1)[0]
        assert list(levels) == sorted(set(levels))
        assert all(0.0 < level < 1.0 for level in levels)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (GRAVITY + "mannitol: {permeability_levels: 3}\n", "mannitol"),
        ("swelling: {pressure_levels: 2}\n", "swelling"),
        (GRAVITY + "model: {element: P2}\n", "model.element: P2"),
        (GRAVITY + "model: {time: {duration_s: 3600, dt_s: 60}}\n", "model.time: transient"),
        (GRAVITY + "model: {skull: contact}\n", "model.skull: contact"),
        (GRAVITY + "tolerance_mm: 1.0\n", "tolerance_mm"),
    ],
)
def test_what_is_not_modelled_is_refused_by_name(tmp_path, text, key):
    with pytest.raises(InputError, match="does not model") as caught:
        entries_of(scene_of(tmp_path, text), "scene.yaml")
    assert key in caught.value.problem
    assert caught.value.source == "scene.yaml"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not YAML"),
        ("", "no keys"),
        ("resection: both\n", "no mechanism"),
        (GRAVITY + "resection: maybe\n", "resection"),
        (GRAVITY + "version: 2\n", "version"),
        (GRAVITY + "fluid: 3\n", "fluid"),
        (GRAVITY.replace("-1.0", "-2.0"), "unit vector"),
        (GRAVITY.replace("-1.0", ".nan"), "gravity.direction"),
        (GRAVITY.replace("orientations: 5", "orientations: 0"), "gravity.orientations"),
        (GRAVITY.replace("cone_deg: 20", "cone_deg: 120"), "gravity.cone_deg"),
        (GRAVITY + "septa: [1]\n", "septa"),
    ],
)
def test_faulty_scene_is_one_clear_error(tmp_path, text, words):
    with pytest.raises(InputError, match=words) as caught:
        scene_of(tmp_path, text)
    assert caught.value.source.endswith("scene.yaml")


def test_missing_scene_names_the_file(tmp_path):
    with pytest.raises(InputError, match=r"absent\.yaml: no such file"):
        read_scene(tmp_path / "absent.yaml")

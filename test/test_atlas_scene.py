"""From scene files to atlas entries, and scenes that are refused."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainshift_ros.atlas.columns import entries_of, fluid_levels, groups_of, permeability_levels, pressure_levels
from brainshift_ros.atlas.jobs import jobs_of
from brainshift_ros.atlas.scene import Gravity, Mannitol, Scene, read_scene
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


DEFAULT = """
gravity: {direction: [0.0, -0.94, -0.34], cone_deg: 20, orientations: 60, fluid_levels: 3}
mannitol: {permeability_levels: 3}
resection: both
"""


def test_default_scene_has_720_entries_that_differ(tmp_path):
    entries = entries_of(scene_of(tmp_path, DEFAULT))
    assert len(entries) == len(set(entries)) == 720
    for mechanism in ("gravity", "mannitol"):
        for resected in (False, True):
            chosen = [e for e in entries if e.mechanism == mechanism and e.resected == resected]
            assert len(chosen) == 180
            assert len({entry.gravity_direction for entry in chosen}) == 60
    # All entries of an orientation stand together, those of a resection state too.
    states = [(entry.resected, entry.gravity_direction) for entry in entries]
    assert sum(a != b for a, b in pairwise(states)) == 119


def test_levels_of_drug_and_swelling_are_numbered_from_one_and_span_their_range(tmp_path):
    text = "head: {direction: [0.0, 0.0, -1.0], orientations: 1}\nmannitol: {permeability_levels: 3}\n"
    entries = entries_of(scene_of(tmp_path, text + "swelling: {pressure_levels: 2}\n"))
    assert [(e.mechanism, e.drug_level, e.intensity) for e in entries] == [
        ("mannitol", 1, 0.0),
        ("mannitol", 2, 0.5),
        ("mannitol", 3, 1.0),
        ("swelling", 1, 0.5),
        ("swelling", 2, 1.0),
    ]
    assert {entry.fluid_level for entry in entries} == {1.0}
    for count in (1, 2, 5, 20):
        for levels in (permeability_levels(count), pressure_levels(count)):
            assert len(set(levels)) == count
            assert levels[-1] == 1.0
            assert list(levels) == sorted(levels)
        assert pressure_levels(count)[0] > 0.0  # no pressure is no entry


def test_drugs_without_gravity_need_to_know_how_the_head_lies(tmp_path):
    with pytest.raises(InputError, match="how the head lies") as caught:
        scene_of(tmp_path, "swelling: {pressure_levels: 2}\n")
    assert "head: {direction" in caught.value.remedy
    with pytest.raises(InputError, match="both gravity and head"):
        scene_of(tmp_path, GRAVITY + "head: {direction: [0.0, 0.0, -1.0]}\n")
    alone = entries_of(scene_of(tmp_path, "head: {direction: [0.0, 0.0, -1.0], orientations: 7}\nmannitol: {}\n"))
    assert {entry.mechanism for entry in alone} == {"mannitol"}
    assert len(alone) == 21


def test_a_tolerance_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match="asks for tolerance_mm") as caught:
        entries_of(scene_of(tmp_path, GRAVITY + "tolerance_mm: 1.0\n"), "scene.yaml")
    assert caught.value.source == "scene.yaml"


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 40), st.integers(1, 20), st.integers(0, 3), st.sampled_from(["none", "both"]), st.integers(1, 100))
def test_jobs_are_the_entries_in_order_and_divide_no_orientation(orientations, levels, drug_levels, resection, size):
    gravity = Gravity(direction=(0.0, 0.0, -1.0), orientations=orientations, fluid_levels=levels)
    mannitol = Mannitol(permeability_levels=drug_levels) if drug_levels else None
    entries = entries_of(Scene(gravity=gravity, mannitol=mannitol, resection=resection))
    jobs = jobs_of(entries, size)
    assert tuple(entry for job in jobs for entry in job.entries) == entries
    assert [job.number for job in jobs] == list(range(len(jobs)))
    assert all(job.stop == following.first for job, following in pairwise(jobs))
    assert all(len({entry.resected for entry in job.entries}) == 1 for job in jobs)
    assert all(len(job.entries) <= max(size, levels + drug_levels) for job in jobs)
    for job, following in pairwise(jobs):
        assert (job.resected, job.entries[-1].gravity_direction) != (following.resected, following.entries[0].gravity_direction)
    # No more jobs than it takes, and even ones.
    for resected in {job.resected for job in jobs}:
        sizes = [len(job.entries) // (levels + drug_levels) for job in jobs if job.resected == resected]
        assert max(sizes) - min(sizes) <= 1
        assert len(sizes) == -(-orientations // max(1, size // (levels + drug_levels)))


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
        (GRAVITY + "swelling: {margin_mm: -1}\n", "swelling.margin_mm"),
    ],
)
def test_faulty_scene_is_one_clear_error(tmp_path, text, words):
    with pytest.raises(InputError, match=words) as caught:
        scene_of(tmp_path, text)
    assert caught.value.source.endswith("scene.yaml")


def test_missing_scene_names_the_file(tmp_path):
    with pytest.raises(InputError, match=r"absent\.yaml: no such file"):
        read_scene(tmp_path / "absent.yaml")

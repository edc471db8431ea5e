"""Rows of an atlas that lies in a file, points beside the mesh, and sum limits that the file holds."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from mechanics_cases import head, patient

from brainshift_ros.atlas.columns import entries_of, groups_of
from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.atlas.file import AtlasContent, open_atlas, write_atlas
from brainshift_ros.atlas.scene import Gravity, Mannitol, Scene, WeightSums
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.methods import solve_weights
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.inverse.weighting import weighted_problem
from brainshift_ros.mesh.locate import PointLocator

SCENE = Scene(
    gravity=Gravity(direction=(0.0, 0.0, -1.0), orientations=30, fluid_levels=3),
    mannitol=Mannitol(permeability_levels=2),
    weight_sums=WeightSums(preoperative=0.6, retraction=0.25),
)
PATIENT = patient(head(10))
MESH = PATIENT.mesh
ENTRIES = entries_of(SCENE)
LOCATOR = PointLocator(MESH)
E = np.random.default_rng(0).normal(size=(len(MESH.nodes), 3, len(ENTRIES))).astype(np.float32)


@pytest.fixture(scope="module")
def atlas(tmp_path_factory):
    path = tmp_path_factory.mktemp("rows") / "atlas.h5"
    groups = groups_of(ENTRIES, SCENE.weight_sums)
    write_atlas(path, AtlasContent(PATIENT.patient_id, MESH, PATIENT.tissue, SCENE, ENTRIES, groups), E)
    with open_atlas(path) as opened:
        yield opened


def inside(count, seed=0):
    """Points in the mesh, away from its nodes."""
    rng = np.random.default_rng(seed)
    elements = MESH.elements[rng.choice(len(MESH.elements), count)]
    return np.einsum("na,nai->ni", rng.dirichlet(np.ones(4), count), MESH.nodes[elements])


def measured(points):
    return HomologousPoints(points, np.zeros_like(points), np.full(len(points), 1e-3))


def test_rows_from_the_file_are_the_interpolated_matrix(atlas):
    points = inside(200)
    rows = rows_at_points(AppendedAtlas(atlas, None), measured(points), locator=LOCATOR)
    expected = LOCATOR.locate(points).interpolate(MESH, E.astype(np.float64))
    np.testing.assert_allclose(rows.M, expected, rtol=0.0, atol=1e-12 * np.abs(E).max())
    assert rows.warnings == ()


def test_few_points_need_little_of_the_file(atlas):
    points = measured(inside(8))
    whole = AppendedAtlas(atlas, None)
    rows_at_points(whole, points, locator=LOCATOR)
    tracemalloc.start()
    rows_at_points(whole, points, locator=LOCATOR)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.15 * E.nbytes  # 32 of 1,400 nodes, in double precision


@pytest.mark.parametrize("count", [3, 4000])
def test_any_list_of_rows_is_that_of_the_matrix(atlas, count):
    ids = np.random.default_rng(count).integers(0, len(E), count)
    np.testing.assert_array_equal(atlas.rows(ids), E[ids])


def test_points_beside_the_mesh_take_the_nearest_surface_point(atlas):
    corners = MESH.nodes[MESH.facets["skull"]]
    a, b, c = corners[np.argmax(corners[:, :, 0].sum(axis=1))]
    middle, normal = (a + b + c) / 3.0, np.cross(b - a, c - a)
    normal *= np.sign(normal @ middle) / np.linalg.norm(normal)
    points = middle + np.array([[-1e-6], [0.0029], [0.0031]]) * normal
    rows = rows_at_points(AppendedAtlas(atlas, None), measured(points), locator=LOCATOR, max_outside_mm=3.0)
    assert rows.kept.tolist() == [0, 1]
    np.testing.assert_allclose(rows.M[1], rows.M[0], atol=1e-3)
    assert rows.located.distance_m[1] == pytest.approx(0.0029, rel=1e-3)
    assert rows.warnings == ("1 of 3 points lie more than 3 mm outside the brain and were dropped",)
    with pytest.raises(InputError, match=r"none of 1 points lies within 1 mm of the brain \(nearest: 3 mm\)"):
        rows_at_points(AppendedAtlas(atlas, None), measured(points[2:]), locator=LOCATOR, max_outside_mm=1.0)


def test_sum_limits_are_those_of_the_file(atlas):
    retraction = np.random.default_rng(1).normal(size=(2, len(E), 3)).astype(np.float32)
    whole = AppendedAtlas(atlas, retraction)
    count = len(ENTRIES)
    assert whole.groups == (
        WeightGroup("preoperative", tuple(range(count)), 0.6),
        WeightGroup("retraction", (count, count + 1), 0.25),
    )
    points = inside(40)
    rows = rows_at_points(whole, measured(points), locator=LOCATOR)
    shift = rows.M[:, :, 3] + rows.M[:, :, count]  # a whole column of each group, which neither may reach
    solution = solve_weights(weighted_problem(rows.M, shift, np.ones(40), whole.groups))
    assert solution.saturated == ("preoperative", "retraction")
    assert solution.weights[:count].sum() == pytest.approx(0.6)
    assert solution.weights[count:].sum() == pytest.approx(0.25)


def test_without_a_blade_there_is_one_group(atlas):
    assert [group.name for group in AppendedAtlas(atlas, None).groups] == ["preoperative"]


def test_an_atlas_that_names_no_retraction_gives_it_the_sum_of_6_3(atlas):
    class Older:
        mesh, entries, groups = atlas.mesh, atlas.entries, atlas.groups[:1]

    appended = AppendedAtlas(Older(), np.zeros((1, len(E), 3), dtype=np.float32)).groups[1]
    assert appended == WeightGroup("retraction", (len(ENTRIES),), 1.0)


def test_a_sum_limit_that_is_not_positive_is_refused(tmp_path):
    groups = (replace(groups_of(ENTRIES)[0], sum_limit=0.0),)
    write_atlas(tmp_path / "a.h5", AtlasContent(PATIENT.patient_id, MESH, PATIENT.tissue, SCENE, ENTRIES, groups), E)
    with pytest.raises(InputError, match="sum limit"):
        open_atlas(tmp_path / "a.h5")

"""Base of the studies of the inverse model: atlases, truths, measured points and targets, on a ball with tumour and falx."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import head, patient

from brainshift_ros.experiments import inverse_cases, inverse_truths
from brainshift_ros.experiments.inverse_cases import (
    Targets,
    columns_where,
    mean_of_points,
    measure,
    opening_facets,
    study_atlas,
    study_scene,
    subset,
)
from brainshift_ros.experiments.inverse_truths import (
    PLANNED,
    SURFACE_SHIFT_MM,
    InverseTruth,
    TruthSpec,
    collapsed,
    drawn_truth,
    solve_truth,
    solved_truths,
    tilted,
)
from brainshift_ros.experiments.patients import craniotomy_opening
from brainshift_ros.image.volume import Region
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.mechanics.cases import Case
from brainshift_ros.mechanics.forward import solve_case, solve_system
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.units import mm_to_m

SPEC = TruthSpec(seed=3, direction=PLANNED, fluid_level=0.5)


@pytest.fixture(scope="module")
def small_patient():
    mesh = head(6)
    return patient(replace(mesh, nodes=mesh.nodes + mm_to_m([-35.0, 45.0, 50.0]) + 0.06 * np.array(PLANNED)))


@pytest.fixture(scope="module")
def built(small_patient, tmp_path_factory):
    """A study's atlas, and a second call's, which must not build."""
    folder = tmp_path_factory.mktemp("study")
    scene = study_scene(orientations=3, fluid_levels=2, permeability_levels=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inverse_cases, "template_patient", lambda *_: small_patient)
        first = study_atlas(folder, scene, lambda *_: None, nodes=200)
        patch.setattr(inverse_cases, "build_atlas", None)
        return first, study_atlas(folder, scene, lambda *_: None, nodes=200)


@pytest.fixture(scope="module")
def system(small_patient):
    return assemble_system(small_patient.mesh, material_of(small_patient.tissue))


@pytest.fixture(scope="module")
def truth(small_patient):
    return solve_truth(small_patient, replace(SPEC, surface_shift_mm=7.0))


def test_a_study_s_atlas_is_the_builder_s_and_is_kept(built, small_patient, system):
    atlas, again = built
    assert len(atlas.entries) == 2 * 3 * (2 + 1)
    assert {entry.mechanism for entry in atlas.entries} == {"gravity", "mannitol"}
    assert (again.atlas_id, again.entries) == (atlas.atlas_id, atlas.entries)
    np.testing.assert_array_equal(again.E, atlas.E)
    opening = craniotomy_opening(small_patient.mesh)
    entry = atlas.entries[1]
    expected = solve_system(system, entry.gravity_direction, entry.fluid_level, skull="contact", opening=opening).displacement
    np.testing.assert_allclose(atlas.E[:, :, 1], expected, atol=1e-6 * np.abs(expected).max())


def test_a_subset_is_an_atlas_of_its_own(built):
    atlas, _ = built
    gravity = columns_where(atlas, lambda entry: entry.mechanism == "gravity")
    part = subset(atlas, gravity)
    assert {entry.mechanism for entry in part.entries} == {"gravity"}
    assert part.groups[0].columns == tuple(range(len(gravity)))
    assert part.atlas_id != atlas.atlas_id
    np.testing.assert_array_equal(part.columns([1]), atlas.columns([gravity[1]]))
    mask = np.zeros(len(atlas.entries), dtype=bool)
    mask[gravity] = True
    assert subset(atlas, mask).entries == part.entries


def test_columns_without_weight_may_be_left_out(built, truth):
    atlas, _ = built
    locator = PointLocator(atlas.mesh)
    measured = measure(truth, 20, 5e-4, np.random.default_rng(1))
    whole = estimate_shift(atlas, measured, locator=locator)
    part = estimate_shift(subset(atlas, whole.solution.weights > 0.0), measured, locator=locator)
    np.testing.assert_allclose(part.field.displacement, whole.field.displacement, atol=1e-9)


def test_a_truth_of_even_stiffness_is_the_reference_s_solution(small_patient, system):
    opening = craniotomy_opening(small_patient.mesh)
    found = solve_truth(small_patient, replace(SPEC, stiffness_spread=0.0)).displacement
    expected = solve_system(system, PLANNED, SPEC.fluid_level, skull="contact", opening=opening).displacement
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_gravity_and_drug_add_up_where_no_contact_is_one_sided(small_patient, system):
    spec = replace(SPEC, stiffness_spread=0.0, mannitol=0.3, permeability=0.5, skull="free_cap")
    found = solve_truth(small_patient, spec).displacement
    gravity, drug = (
        solve_case(system, Case(mechanism, PLANNED, level, intensity)).displacement
        for mechanism, level, intensity in (("gravity", SPEC.fluid_level, 0.0), ("mannitol", 1.0, 0.5))
    )
    np.testing.assert_allclose(found, gravity + 0.3 * drug, atol=1e-8 * np.abs(found).max())


def test_under_contact_they_do_not(small_patient):
    """Else a mixture would be a sum of columns, and the truths easier than the brain."""
    spec = replace(SPEC, direction=tilted(PLANNED, 1.5, 2.0), stiffness_spread=0.0)
    gravity, once, twice = (solve_truth(small_patient, replace(spec, mannitol=share)).displacement for share in (0.0, 0.3, 0.6))
    assert np.abs((twice - gravity) - 2.0 * (once - gravity)).max() > 0.01 * np.abs(twice).max()


def test_a_truth_is_as_large_as_asked_and_leaves_the_tumour_out_if_resected(small_patient, truth):
    mesh = small_patient.mesh
    seen = craniotomy_opening(mesh)
    assert np.linalg.norm(truth.displacement[seen], axis=1).mean() == pytest.approx(7e-3)
    assert truth.tissue.all()
    resected = solve_truth(small_patient, replace(SPEC, resected=True))
    gone = np.setdiff1d(mesh.elements[mesh.region == Region.TUMOR], mesh.elements[mesh.region != Region.TUMOR])
    np.testing.assert_array_equal(np.flatnonzero(~resected.tissue), gone)


@pytest.mark.slow
def test_a_small_shift_at_finite_strain_is_linear(small_patient):
    small = replace(SPEC, surface_shift_mm=0.05)
    linear, finite = (solve_truth(small_patient, s).displacement for s in (small, replace(small, finite_strain=True)))
    assert np.abs(finite - linear).max() < 0.03 * np.abs(linear).max()


def test_a_finite_strain_truth_with_a_drug_is_refused(small_patient):
    with pytest.raises(ValueError, match="gravity and skull contact alone"):
        solve_truth(small_patient, replace(SPEC, finite_strain=True, mannitol=0.2))


def test_truths_are_solved_once(small_patient, tmp_path, monkeypatch):
    specs = [SPEC, replace(SPEC, seed=4)]
    first = list(solved_truths(tmp_path, [small_patient], specs, lambda *_: None))
    monkeypatch.setattr(inverse_truths, "solve_truth", None)
    second = list(solved_truths(tmp_path, [small_patient], specs, lambda *_: None))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.displacement, b.displacement)
        np.testing.assert_array_equal(a.tissue, b.tissue)
    assert not np.array_equal(first[0].displacement, first[1].displacement)


def test_a_collapse_pulls_towards_the_tumour_by_at_most_its_depth(truth):
    added = collapsed(truth, 5e-3).displacement - truth.displacement
    tumor = np.unique(truth.mesh.elements[truth.mesh.region == Region.TUMOR])
    outwards = truth.mesh.nodes - truth.mesh.nodes[tumor].mean(axis=0)
    assert np.linalg.norm(added, axis=1).max() <= 5e-3
    assert np.linalg.norm(added, axis=1).max() > 4e-3
    assert (np.einsum("ni,ni->n", added, outwards) <= 0.0).all()


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_drawn_truths_stay_in_their_ranges(seed):
    spec = drawn_truth(seed)
    assert spec == drawn_truth(seed)
    assert np.degrees(np.arccos(np.dot(spec.direction, tilted(PLANNED, 0.0, 0.0)))) <= 20.0 + 1e-6
    assert SURFACE_SHIFT_MM[0] <= spec.surface_shift_mm <= SURFACE_SHIFT_MM[1]
    assert spec.resected == (seed % 2 == 1)
    assert (spec.mannitol > 0.0) == (seed // 2 % 2 == 1)


@given(st.floats(0.0, 1.5), st.floats(0.0, 6.3))
@settings(max_examples=30, deadline=None)
def test_a_tilt_is_as_far_as_asked(angle, azimuth):
    direction = tilted(PLANNED, angle, azimuth)
    assert np.linalg.norm(direction) == pytest.approx(1.0)
    assert np.dot(direction, PLANNED) / np.linalg.norm(PLANNED) == pytest.approx(np.cos(angle), abs=1e-12)


def test_measured_points_carry_the_displacement_between_nodes_and_the_noise(truth):
    gradient = np.random.default_rng(0).normal(size=(3, 3))
    linear = replace(truth, displacement=truth.mesh.nodes @ gradient)
    exact = measure(linear, 300, 1e-12, np.random.default_rng(0))
    np.testing.assert_allclose(exact.displacements, exact.points @ gradient, atol=1e-9)
    noisy = measure(linear, 300, 5e-4, np.random.default_rng(0))
    np.testing.assert_array_equal(noisy.points, exact.points)
    assert (noisy.displacements - exact.displacements).std() == pytest.approx(5e-4, rel=0.1)
    corners = truth.mesh.nodes[opening_facets(truth.mesh)].reshape(-1, 3)
    assert (exact.points >= corners.min(axis=0) - 1e-12).all()
    assert (exact.points <= corners.max(axis=0) + 1e-12).all()


def test_errors_at_targets_by_hand(built, truth):
    atlas, _ = built
    locator = PointLocator(atlas.mesh)
    targets = Targets(truth, atlas, locator)
    assert {"surface", "subsurface"} <= set(targets.groups)
    perfect = {row["group"]: row for row in targets.errors(truth.displacement)}
    nothing = {row["group"]: row for row in targets.errors(np.zeros_like(truth.displacement))}
    twice = {row["group"]: row for row in targets.errors(2.0 * truth.displacement)}
    surface = np.linalg.norm(truth.displacement[targets.groups["surface"]], axis=1).mean() * 1e3
    for group, row in perfect.items():
        assert row["correction_percent"] == pytest.approx(100.0)
        assert nothing[group]["correction_percent"] == pytest.approx(0.0, abs=1e-9)
        assert twice[group]["correction_percent"] == pytest.approx(0.0, abs=1e-9)
        assert nothing[group]["angular_error_deg"] is None
        assert twice[group]["angular_error_deg"] == pytest.approx(0.0, abs=1e-5)
    assert nothing["surface"]["error_mm"] == pytest.approx(surface)
    named = next(row for row in targets.errors(truth.displacement, {"two": np.array([3, 4])}) if row["group"] == "two")
    assert named["targets"] == 2


def test_targets_lie_where_there_is_tissue(built, small_patient):
    atlas, _ = built
    resected = solve_truth(small_patient, replace(SPEC, resected=True))
    targets = Targets(resected, atlas, PointLocator(atlas.mesh))
    assert all(resected.tissue[ids].all() for ids in targets.groups.values())


def test_values_of_the_atlas_are_read_between_its_nodes(built, small_patient):
    atlas, _ = built
    finer = replace(small_patient.mesh, nodes=0.99 * small_patient.mesh.nodes + 0.01 * small_patient.mesh.nodes.mean(axis=0))
    other = InverseTruth(SPEC, finer, np.zeros_like(finer.nodes), np.ones(len(finer.nodes), dtype=bool))
    targets = Targets(other, atlas, PointLocator(atlas.mesh))
    read = targets.at_targets(atlas.mesh.nodes @ np.array([1.0, 2.0, 3.0]))
    ids = np.unique(np.concatenate(list(targets.groups.values())))
    np.testing.assert_allclose(read[ids], finer.nodes[ids] @ [1.0, 2.0, 3.0], atol=1e-3)


def test_the_mean_of_the_points_moves_everything_alike(built, truth):
    measured = measure(truth, 15, 5e-4, np.random.default_rng(0))
    field = mean_of_points(built[0], measured)
    assert field.shape == built[0].mesh.nodes.shape
    np.testing.assert_allclose(field, np.broadcast_to(measured.displacements.mean(axis=0), field.shape))

"""Edges of the estimate (spec E8): measurements and atlases that leave the weights undetermined, or contradict them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from field_cases import MemoryAtlas, ellipsoid_mesh, sag, sagging_atlas, top_nodes

from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.mesh.locate import PointLocator

MESH = ellipsoid_mesh(10)
ATLAS = sagging_atlas(MESH)
LOCATOR = PointLocator(MESH)

#: Relative KKT residual of an exact answer.
EXACT = 1e-12


def mixture():
    return ATLAS.E[:, :, :2].astype(float) @ [0.5, 0.3]


def outside_truth(seed=0):
    """A sag that is no combination of the atlas's columns."""
    direction = np.random.default_rng(seed).normal([0.1, -1.0, -0.05], 0.1)
    return sag(MESH.nodes, direction / np.linalg.norm(direction), 0.009, 1.55)


def measure(truth, count=20, noise=0.0, seed=0):
    nodes = top_nodes(MESH, count, seed)
    u = truth[nodes] + np.random.default_rng(seed + 100).normal(size=(count, 3)) * noise
    return HomologousPoints(MESH.nodes[nodes], u, np.full(count, max(noise, 1e-4)))


def at(points, truth, sigma=1e-4):
    return HomologousPoints(points, LOCATOR.locate(points, 0.01).interpolate(MESH, truth), np.full(len(points), sigma))


def estimate(measured, atlas=ATLAS, **options):
    return estimate_shift(atlas, measured, options=InverseOptions(**options), locator=LOCATOR)


def error(result, truth):
    return np.linalg.norm(result.field.displacement - truth, axis=1)


def atlas_of(E, mesh=MESH):
    columns = E.shape[2]
    entries = tuple(AtlasEntry("gravity", (0.0, -1.0, 0.0), 0.5, 0, False) for _ in range(columns))
    return MemoryAtlas(mesh, E.astype(np.float32), entries, (WeightGroup("preoperative", tuple(range(columns))),))


def said(result, text):
    return any(text in line for line in result.warnings)


def refused(result, text):
    return not result.valid and any(text in line for line in result.reasons)


def assert_sound(result):
    """Whatever is wrong with the measurement, the answer is optimal and finite."""
    assert result.solution.kkt_residual < EXACT
    assert np.isfinite(result.field.displacement).all()
    assert np.isfinite(result.field.std).all()
    assert (result.field.std > 0.0).all()


def test_duplicate_columns_give_the_same_field():
    measured = measure(outside_truth(), noise=5e-4)
    twice = estimate(measured, atlas_of(np.repeat(ATLAS.E, 2, axis=2)))
    assert_sound(twice)
    np.testing.assert_allclose(twice.field.displacement, estimate(measured).field.displacement, atol=1e-6)


def test_columns_that_are_multiples_of_each_other():
    E = ATLAS.E[:, :, [0, 0, 0, 5, 5]] * np.array([1.0, 0.5, 0.25, 1.0, 0.75])
    truth = 0.4 * ATLAS.E[:, :, 0].astype(float) + 0.2 * ATLAS.E[:, :, 5]
    result = estimate(measure(truth), atlas_of(E))
    assert_sound(result)
    assert error(result, truth).max() < 1e-5


def test_the_weight_of_a_duplicate_is_said_to_be_uncertain_though_the_field_is_not():
    measured = measure(ATLAS.E[:, :, 0].astype(float) * 0.8)
    once, twice = (estimate(measured, atlas_of(ATLAS.E[:, :, columns])) for columns in ([0], [0, 0]))
    assert once.weights[0].std < 0.03
    assert max(weight.std for weight in twice.weights) > 0.2
    assert twice.mechanisms["gravity"].weight_sum_std < 0.03
    np.testing.assert_allclose(once.field.std, twice.field.std, rtol=0.5)


def test_one_column():
    result = estimate(measure(0.7 * ATLAS.E[:, :, 0].astype(float)), atlas_of(ATLAS.E[:, :, :1]))
    assert_sound(result)
    assert result.valid
    assert result.weights[0].weight == pytest.approx(0.7, abs=1e-3)


def test_ten_thousand_columns():
    mesh = ellipsoid_mesh(6)
    own = sagging_atlas(mesh)
    shares = np.random.default_rng(0).dirichlet(np.full(40, 0.1), 10_000).T
    atlas = atlas_of(own.E @ shares.astype(np.float32), mesh)
    truth = own.E[:, :, :2].astype(float) @ [0.5, 0.3]
    nodes = top_nodes(mesh, 20, above=0.3)
    u = truth[nodes] + np.random.default_rng(1).normal(0.0, 3e-4, (20, 3))
    result = estimate_shift(atlas, HomologousPoints(mesh.nodes[nodes], u, np.full(20, 3e-4)))
    assert_sound(result)
    assert result.valid
    assert error(result, truth).mean() < 5e-4


def test_a_column_of_zeros_is_left_alone():
    E = np.concatenate([np.zeros_like(ATLAS.E[:, :, :1]), ATLAS.E], axis=2)
    result = estimate(measure(mixture()), atlas_of(E))
    assert_sound(result)
    assert 0 not in {weight.column for weight in result.weights}


def test_an_atlas_that_moves_nothing():
    result = estimate(measure(mixture()), atlas_of(np.zeros_like(ATLAS.E)))
    assert refused(result, "every weight is zero")
    assert not result.field.displacement.any()


def test_an_atlas_that_is_not_finite_is_refused():
    E = ATLAS.E.copy()
    E[:, :, 3] = np.nan
    with pytest.raises(InputError, match="columns hold values that are not finite"):
        estimate(measure(mixture()), atlas_of(E))


@pytest.mark.parametrize("count", [1, 3, 4])
def test_too_few_points_are_not_valid(count):
    result = estimate(measure(mixture(), count))
    assert refused(result, f"{count} points in use, 5 are needed")
    assert_sound(result)


def test_one_point_leaves_more_uncertain_than_many():
    one, many = (estimate(measure(mixture(), count, noise=3e-4)).field.std for count in (1, 30))
    assert np.median(one) > 1.5 * np.median(many)


def test_three_points_on_a_line():
    result = estimate(at(np.linspace([-0.02, 0.054, 0.0], [0.02, 0.054, 0.0], 3), mixture()))
    assert refused(result, "3 points in use")
    assert said(result, "nearly on a line")
    assert_sound(result)


def test_points_on_a_line_are_said():
    result = estimate(at(np.linspace([-0.02, 0.054, 0.0], [0.02, 0.054, 0.0], 8), mixture()))
    assert said(result, "nearly on a line")
    assert_sound(result)


def test_all_points_in_a_corner():
    corner = np.array([-0.02, 0.054, 0.0]) + np.random.default_rng(0).normal(size=(8, 3)) * 1e-3
    result = estimate(at(corner, mixture()))
    assert said(result, "patch of only")
    assert_sound(result)
    spread = estimate(measure(mixture(), 8))
    assert np.median(result.field.std) > np.median(spread.field.std)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_scattered_outliers_are_dropped_and_said(share):
    truth = outside_truth()
    measured = measure(truth, 30, noise=5e-4)
    wrong = np.arange(int(share * 30))
    u = measured.displacements.copy()
    u[wrong] += np.random.default_rng(1).normal(size=(wrong.size, 3)) * 0.012 + [0.006, 0.006, 0.0]
    with_outliers, clean = estimate(replace(measured, displacements=u)), estimate(measured)
    assert not with_outliers.used[wrong].any()
    assert with_outliers.used[wrong.size :].all()
    assert said(with_outliers, f"{wrong.size} of 30 points were dropped as outliers")
    assert error(with_outliers, truth).mean() < error(clean, truth).mean() + 5e-4


@pytest.mark.parametrize("seed", range(3))
def test_neighbouring_outliers_that_agree_with_each_other_are_dropped(seed):
    truth = outside_truth()
    measured = measure(truth, 30, noise=5e-4, seed=seed)
    rng = np.random.default_rng(seed)
    wrong = np.argsort(np.linalg.norm(measured.points - measured.points[0], axis=1))[:9]
    direction = rng.normal(size=3)
    u = measured.displacements.copy()
    u[wrong] += 0.008 * direction / np.linalg.norm(direction)
    result = estimate(replace(measured, displacements=u))
    assert not result.used[wrong].any()
    assert result.used.sum() == 21
    assert error(result, truth).mean() < 1e-3


def test_half_of_the_points_wrong_is_not_valid():
    measured = measure(mixture(), 30, noise=5e-4)
    u = measured.displacements.copy()
    u[:14] += np.random.default_rng(1).normal(size=(14, 3)) * 0.02
    assert refused(estimate(replace(measured, displacements=u)), "contradict the others")


def test_noise_alone_makes_no_outliers():
    used = [estimate(measure(outside_truth(seed), 30, noise=1e-3, seed=seed)).used.mean() for seed in range(5)]
    assert np.mean(used) > 0.99


def test_points_that_are_noisier_than_they_say_are_said():
    measured = measure(mixture(), 24, noise=1e-3)
    deceived = estimate(replace(measured, sigma=np.full(24, 2e-4)))
    honest = estimate(measured)
    assert said(deceived, "times as much as their sigma says")
    assert not said(honest, "their sigma says")
    assert deceived.field.std.mean() > 0.5 * honest.field.std.mean()


@pytest.mark.parametrize("sigma", [1e-15, 1e-9, 0.1, 1e6])
def test_any_positive_sigma_gives_a_finite_answer(sigma):
    measured = measure(mixture(), 12)
    points, u = (np.repeat(values, 2, axis=0) for values in (measured.points, measured.displacements))
    result = estimate(HomologousPoints(points, u, np.full(24, sigma)))
    assert np.isfinite(result.field.std).all()
    assert np.isfinite(result.field.displacement).all()
    assert result.solution.kkt_residual < EXACT


def test_two_points_at_one_place_that_contradict():
    measured = measure(mixture(), 12, noise=3e-4)
    contrary = measured.displacements[0] + np.array([0.0, 0.009, 0.0])
    doubled = HomologousPoints(
        np.vstack([measured.points, measured.points[0]]),
        np.vstack([measured.displacements, contrary]),
        np.append(measured.sigma, 3e-4),
    )
    result = estimate(doubled)
    assert result.used.tolist() == [True] * 12 + [False]
    assert said(result, "1 of 13 points were dropped")
    np.testing.assert_allclose(result.field.displacement, estimate(measured).field.displacement, atol=1e-6)


def test_zero_shift_is_said():
    result = estimate(measure(np.zeros_like(MESH.nodes)))
    assert result.correction_percent is None
    assert result.angular_error_deg is None
    assert not result.field.displacement.any()
    assert said(result, "not above its own noise")
    assert_sound(result)


def test_noise_without_shift_is_said():
    result = estimate(measure(np.zeros_like(MESH.nodes), noise=1e-3))
    assert said(result, "not above its own noise")
    assert (np.linalg.norm(result.field.displacement, axis=1) < 4.0 * result.field.std).all()


def test_a_shift_larger_than_any_column_saturates_and_is_said():
    result = estimate(measure(3.0 * ATLAS.E[:, :, int(np.argmax(np.abs(ATLAS.E).max(axis=(0, 1))))].astype(float)))
    assert result.solution.saturated == ("gravity",)
    assert said(result, "reached their limit")
    assert not result.valid
    assert_sound(result)


def test_a_shift_against_all_columns_has_zero_weights_and_is_not_valid():
    result = estimate(measure(-mixture()))
    assert refused(result, "every weight is zero")
    assert result.weights == ()


def test_a_shift_against_all_columns_is_not_valid_even_within_a_wide_sigma():
    measured = measure(-mixture())
    shift = np.linalg.norm(measured.displacements, axis=1).mean()
    result = estimate(replace(measured, sigma=np.full(20, shift / 2.5)))
    assert len(result.reasons) == 1
    assert "every weight is zero" in result.reasons[0]


def test_points_of_another_patient_beside_the_brain_are_refused():
    measured = measure(mixture())
    with pytest.raises(InputError, match=r"none of 20 points lies within 5 mm of the brain \(nearest: \d+ mm\)"):
        estimate(replace(measured, points=measured.points + np.array([0.3, 0.0, 0.0])))
    points = measured.points.copy()
    points[:13] += [0.3, 0.0, 0.0]
    assert refused(estimate(replace(measured, points=points)), "another patient")


def test_points_of_another_patient_with_a_like_brain_are_not_told():
    """A brain 3 % larger whose shift is alike: nothing in the points gives it away, only the patient's id does."""
    measured = measure(outside_truth(), 24, noise=5e-4)
    result = estimate(replace(measured, points=1.03 * measured.points))
    assert result.valid
    assert result.correction_percent > 80.0


def test_mechanisms_that_look_alike_at_the_points_are_said_to_be_undetermined():
    """Two mechanisms that move the cortex alike and the depth differently."""
    x, y, z = (MESH.nodes / 0.05).T
    top = sag(MESH.nodes, np.array([0.0, -1.0, 0.0]), 0.01, 1.0)
    deep = np.exp(-((y / 0.4) ** 2) - x**2 - z**2)[:, None] * np.array([0.006, 0.0, 0.0])
    E = np.stack([top, top + deep], axis=2)
    entries = tuple(AtlasEntry(name, (0.0, -1.0, 0.0), 0.5, 0, False) for name in ("gravity", "mannitol"))
    atlas = MemoryAtlas(MESH, E.astype(np.float32), entries, (WeightGroup("preoperative", (0, 1)),))
    truth = top @ np.eye(3) * 0.4 + (top + deep) * 0.4
    result = estimate(measure(truth, 20, noise=3e-4), atlas)
    assert said(result, "do not tell gravity")
    assert sum(share.shift for share in result.mechanisms.values()) == pytest.approx(
        np.linalg.norm(result.estimated, axis=1).mean(), rel=1e-6
    )
    inside = np.linalg.norm(deep, axis=1) > 0.004
    surface = np.linalg.norm(MESH.nodes / [0.05, 0.06, 0.045], axis=1) > 1.0 - 1e-9
    assert result.field.std[inside].mean() > 1.5 * result.field.std[surface].mean()


def test_weights_that_fit_the_noise_are_not_valid_however_small_their_residual():
    """More columns than rows: (3.5) reproduces every point, and is wrong everywhere else."""
    atlas = sagging_atlas(MESH, entries=200)
    measured = measure(outside_truth(), noise=5e-4)
    result = estimate(measured, atlas, method="least_squares")
    assert result.residual_mean < 1e-5
    assert error(result, outside_truth()).mean() > np.linalg.norm(measured.displacements, axis=1).mean()
    assert refused(result, "is uncertain by")
    assert estimate(measured, atlas).valid

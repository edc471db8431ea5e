"""Dense displacement by thin-plate splines, and what it says of its own error."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainshift_ros.correspondence.dense import interpolate
from brainshift_ros.correspondence.error_growth import ErrorGrowth, fit_error_growth
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import tangent_frame

RADIUS_M = 0.035
TILT = tangent_frame(np.array([0.3, -0.5, 0.8])).T


def patch(rng, count, side=1.0):
    """Points of a domed patch somewhere in space; `side` < 1 keeps one side of it."""
    xy = np.zeros((0, 2))
    while len(xy) < count:
        xy = np.concatenate([xy, rng.uniform(-RADIUS_M, RADIUS_M, (4 * count, 2))])
        xy = xy[(np.hypot(*xy.T) < RADIUS_M) & (xy[:, 0] < (2.0 * side - 1.0) * RADIUS_M)]
    xy = xy[:count]
    return np.column_stack([xy, -np.sum(xy**2, axis=1) / 0.15]) @ TILT.T + [0.1, -0.2, 0.3]


@lru_cache
def waves(seed, length_m):
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 1.0 / length_m, (40, 3)), rng.uniform(0, 2 * np.pi, 40), rng.normal(0.0, 1.0, (40, 3))


def smooth_shift(points, seed, length_m=0.03, amplitude_m=4e-3):
    """A random field with a Gaussian correlation, plus sag."""
    k, phase, amplitude = waves(seed, length_m)
    field = np.cos(points @ k.T + phase) @ amplitude * np.sqrt(2.0 / 40)
    return amplitude_m * field + [1e-3, -2e-3, -6e-3]


def measured_points(seed, count=50, side=1.0, noise_m=0.2e-3, length_m=0.03):
    rng = np.random.default_rng([seed, 1])
    points = patch(rng, count, side)
    shift = smooth_shift(points, seed, length_m) + rng.normal(0.0, noise_m, (count, 3))
    return HomologousPoints(points, shift, np.full(count, noise_m))


def test_an_affine_shift_is_met_everywhere():
    rng = np.random.default_rng(0)
    A, b = rng.normal(0, 0.1, (3, 3)), rng.normal(0, 5e-3, 3)
    flat = np.column_stack([rng.uniform(-0.03, 0.03, (25, 2)), np.zeros(25)]) @ TILT.T
    at = np.column_stack([rng.uniform(-0.06, 0.06, (100, 2)), np.zeros(100)]) @ TILT.T
    dense = interpolate(HomologousPoints(flat, flat @ A.T + b, np.full(25, 1e-4)), at)
    np.testing.assert_allclose(dense.displacements, at @ A.T + b, atol=1e-9)


def test_without_noise_the_spline_passes_near_the_points_and_their_sigma_is_small():
    measured = measured_points(1, noise_m=1e-6)
    dense = interpolate(measured, measured.points)
    assert np.abs(dense.displacements - measured.displacements).max() < 0.1e-3
    np.testing.assert_array_equal(dense.distance_m, 0.0)
    assert dense.sigma.max() < 0.3e-3


def scaled_errors(seeds, **options):
    distances, scores = [], []
    for seed in seeds:
        at = patch(np.random.default_rng([seed, 2]), 150)
        dense = interpolate(measured_points(seed, **options), at)
        scores.append((dense.displacements - smooth_shift(at, seed, options.get("length_m", 0.03))) / dense.sigma[:, None])
        distances.append(dense.distance_m)
    return np.concatenate(distances), np.abs(np.concatenate(scores))


@pytest.mark.parametrize("options", [{}, {"count": 15}, {"side": 0.5, "count": 25}])
def test_two_thirds_of_the_errors_lie_within_one_sigma(options):
    distance, score = scaled_errors(range(8), **options)
    assert 0.58 < np.mean(score < 1.0) < 0.87  # held-out errors and priors err on the safe side
    assert np.mean(score < 3.0) > 0.95
    far = distance > np.quantile(distance, 0.8)
    assert 0.5 < np.mean(score[far] < 1.0) < 0.95


def test_a_rougher_shift_has_a_steeper_growth():
    rough, smooth = (fit_error_growth(measured_points(3, length_m=length)) for length in (0.015, 0.06))
    assert rough.sigma(np.array([0.015])) > 3.0 * smooth.sigma(np.array([0.015]))


def test_wrong_points_among_the_measured_do_not_decide_the_growth():
    measured = measured_points(4, count=60)
    moved = measured.displacements.copy()
    moved[[7, 31, 50]] += 8e-3
    spoilt = fit_error_growth(HomologousPoints(measured.points, moved, measured.sigma))
    clean = fit_error_growth(measured)
    assert spoilt.sigma(np.array([0.01])) < 4.0 * clean.sigma(np.array([0.01]))


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.integers(4, 30))
def test_sigma_never_falls_with_distance(seed, count):
    growth = fit_error_growth(measured_points(seed % 50, count))
    sigma = growth.sigma(np.linspace(0.0, 0.1, 200))
    assert np.all(np.diff(sigma) >= 0.0)
    assert np.isfinite(sigma).all()
    assert sigma[0] > 0.0


def test_whole_vessels_are_left_out():
    """Two vessels 12 mm apart: left out as a whole, a vessel's points are 12 mm from what is known."""
    rng = np.random.default_rng(5)
    rows = np.repeat([-18e-3, -6e-3, 6e-3, 18e-3], 12)
    points = np.column_stack([np.tile(np.linspace(-0.03, 0.03, 12), 4), rows + rng.normal(0, 0.1e-3, 48), np.zeros(48)])
    measured = HomologousPoints(points, smooth_shift(points, 5), np.full(48, 0.1e-3))
    alone, by_vessel = (fit_error_growth(measured, ids) for ids in (None, np.repeat(np.arange(4), 12)))
    twelve = [np.sum(np.abs(growth.distances_m - 12e-3) < 0.5e-3) for growth in (alone, by_vessel)]
    assert twelve[1] >= twelve[0] + 24


def test_the_covariance_belongs_to_the_sigmas_and_can_be_inverted():
    measured = measured_points(6)
    dense = interpolate(measured, patch(np.random.default_rng(7), 120), common_m=0.1e-3)
    covariance = dense.covariance()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), dense.sigma, rtol=1e-9)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-18)
    np.linalg.cholesky(covariance)
    near, far = np.argsort(np.linalg.norm(dense.points - dense.points[0], axis=1))[[1, -1]]
    correlation = covariance / np.outer(dense.sigma, dense.sigma)
    assert correlation[0, near] > correlation[0, far]
    with_model = dense.covariance(model_sigma_m=0.5e-3)
    np.testing.assert_allclose(np.diag(with_model), dense.sigma**2 + 0.25e-6)
    np.testing.assert_allclose(with_model - np.diag(np.diag(with_model)), covariance - np.diag(np.diag(covariance)))


def test_what_all_points_share_is_not_averaged_out():
    measured = measured_points(6, noise_m=0.2e-3)
    at = measured.points[:20] + 0.3e-3
    alone, shared = interpolate(measured, at), interpolate(measured, at, common_m=0.18e-3)
    assert (shared.sigma >= 0.18e-3).all()
    assert np.median(alone.sigma) < 0.18e-3


def test_crowded_dense_points_weigh_no_more_together_than_one():
    measured = measured_points(8)
    crowd = measured.points.mean(axis=0) + np.random.default_rng(0).normal(0, 0.05e-3, (60, 3))
    dense = interpolate(measured, crowd)
    together = 1.0 / np.sqrt(np.sum(1.0 / dense.as_independent_points().sigma ** 2))
    assert together == pytest.approx(np.median(dense.sigma), rel=0.1)
    naive = 1.0 / np.sqrt(np.sum(1.0 / dense.as_points().sigma ** 2))
    assert naive < 0.2 * together


def test_beyond_the_points_the_field_says_so():
    measured = measured_points(9, side=0.5)
    inside = interpolate(measured, measured.points.mean(axis=0, keepdims=True))
    assert inside.warnings == ()
    everywhere = interpolate(measured, patch(np.random.default_rng(1), 200))
    assert any("outside the measured ones" in warning and "extrapolated" in warning for warning in everywhere.warnings)
    far = measured.points[:1] + TILT @ [0.3, 0.0, 0.0]
    assert any("fitted to" in warning for warning in interpolate(measured, far).warnings)
    assert interpolate(measured, far).sigma[0] > 5.0 * inside.sigma[0]


def test_a_given_growth_is_used():
    measured = measured_points(10)
    growth = ErrorGrowth(floor_m=1e-3, at_1cm_m=2e-3, power=1.0)
    dense = interpolate(measured, measured.points, growth)
    assert dense.growth is growth
    assert (dense.sigma >= 1e-3).all()


def test_few_points_give_a_field_that_calls_its_sigma_a_guess():
    dense = interpolate(measured_points(11, count=4), patch(np.random.default_rng(2), 30))
    assert np.isfinite(dense.displacements).all()
    assert any("guess" in warning for warning in dense.warnings)


@pytest.mark.parametrize(
    ("points", "at", "told"),
    [
        (np.eye(3), np.zeros((1, 3)), "3 points"),
        (np.linspace(0, 1, 8)[:, None] * [0.01, 0.02, 0.03], np.zeros((1, 3)), "on a line"),
        (np.random.default_rng(0).normal(size=(9, 3)), np.zeros((2, 2)), "shape"),
        (np.random.default_rng(0).normal(size=(9, 3)), np.full((1, 3), np.nan), "not finite"),
        (np.random.default_rng(0).normal(size=(9, 3)), np.zeros((0, 3)), "shape"),
    ],
)
def test_what_cannot_be_interpolated_is_refused(points, at, told):
    with pytest.raises(InputError, match=told):
        interpolate(HomologousPoints(points, np.zeros_like(points), np.full(len(points), 1e-4)), at)

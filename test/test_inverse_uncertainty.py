"""The standard deviation of an estimate: against direct computation, draws from its own model, and its parts by themselves."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import ellipsoid_mesh, sagging_atlas, top_nodes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import gamma, kv

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.inverse import discrepancy
from brainshift_ros.inverse.discrepancy import correlation, likely_amplitudes, local_shift
from brainshift_ros.inverse.gathered import gather
from brainshift_ros.inverse.prior import weight_prior
from brainshift_ros.inverse.span import AtlasSpan, atlas_span
from brainshift_ros.inverse.trimmed import agreeing_half
from brainshift_ros.inverse.uncertainty import condition

MESH = ellipsoid_mesh(6)
ATLAS = sagging_atlas(MESH, 12)
PRIOR = weight_prior(12, ATLAS.groups)
M = ATLAS.E.astype(np.float64)
POINTS = top_nodes(MESH, 10)
NOISE = 5e-4

#: Every column stands for itself, so that nothing is left out.
EVERY_COLUMN = AtlasSpan(ATLAS.E, np.eye(12))


def conditioned(displacements, nodes=POINTS, noise=NOISE):
    return condition(gather(MESH.nodes[nodes], M[nodes], displacements, np.full(len(nodes), noise)), PRIOR)


def dirichlet_covariance():
    """Of shares of a whole among twelve columns and the unused rest, by its textbook formula."""
    mean = np.append(PRIOR.mean, 1.0 - PRIOR.mean.sum())
    total = np.diag(mean) - np.outer(mean, mean)
    return total[:-1, :-1]


def test_the_prior_has_the_moments_of_shares_of_a_whole():
    full = PRIOR.covariance_times(np.eye(12))
    spread = full[0, 0] / dirichlet_covariance()[0, 0]
    assert 0.0 < spread <= 1.0
    np.testing.assert_allclose(full, spread * dirichlet_covariance(), atol=1e-15)
    np.testing.assert_allclose(PRIOR.variance, np.diagonal(full), atol=1e-15)
    draws = np.random.default_rng(0).dirichlet(np.append(PRIOR.mean, 0.5) * (1.0 / spread - 1.0), 50_000)[:, :-1]
    np.testing.assert_allclose(draws.mean(axis=0), PRIOR.mean, atol=4e-3)
    np.testing.assert_allclose(np.cov(draws.T), full, atol=4e-3)


def test_groups_are_independent_and_scale_with_their_limits():
    prior = weight_prior(5, (WeightGroup("a", (0, 1)), WeightGroup("b", (2, 3), 2.0)))
    full = prior.covariance_times(np.eye(5))
    assert not full[:2, 2:].any()
    assert not full[4, :4].any()
    np.testing.assert_allclose(full[2:4, 2:4], 4.0 * full[:2, :2])
    np.testing.assert_allclose(prior.mean, [0.25, 0.25, 0.5, 0.5, 0.5])


def test_the_correlation_is_the_matern_function_of_three_halves():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.0, 0.05, (7, 3)), rng.normal(0.0, 0.05, (4, 3))
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    z = np.sqrt(3.0) * distance / discrepancy.LENGTH
    np.testing.assert_allclose(correlation(a, b), 2.0 ** (1 - 1.5) / gamma(1.5) * z**1.5 * kv(1.5, z), rtol=1e-10)
    assert correlation(a.astype(np.float32), b.astype(np.float32)).dtype == np.float32


def direct_std(brain, weights):
    """The same by dense covariances over all nodes and points, without spans, patterns or single precision."""
    n, m = len(MESH.nodes), M.shape[2]
    share = PRIOR.mean / PRIOR.mean.sum()
    rms = np.sqrt(((M**2) @ share).sum(axis=1))
    size = local_shift(rms, rms[POINTS], brain.shift)
    E = M.reshape(3 * n, m)
    covariance = E @ PRIOR.covariance_times(E.T)
    K = np.kron(correlation(MESH.nodes, MESH.nodes) * np.outer(size, size) / 3.0, np.eye(3))
    covariance += brain.amplitudes.error**2 * K
    at = (3 * POINTS[:, None] + np.arange(3)).ravel()
    measured = covariance[np.ix_(at, at)] + (brain.amplitudes.sigma_factor * NOISE) ** 2 * np.eye(at.size)
    gain = np.linalg.solve(measured, covariance[at]).T
    posterior = np.diagonal(covariance) - np.sum(gain * covariance[:, at], axis=1)
    mean = E @ PRIOR.mean + gain @ (brain.points.displacements - E[at] @ PRIOR.mean)
    return np.sqrt((posterior + (mean - E @ weights) ** 2).reshape(n, 3).mean(axis=1))


def test_node_std_is_that_of_dense_gaussian_conditioning():
    rng = np.random.default_rng(1)
    weights = rng.dirichlet(np.ones(12)) * 0.8
    brain = conditioned(M[POINTS] @ weights + rng.normal(0.0, NOISE, (10, 3)))
    found = brain.node_std(MESH.nodes, EVERY_COLUMN, weights)
    np.testing.assert_allclose(found, direct_std(brain, weights), rtol=2e-2)
    wrong = np.zeros(12)
    np.testing.assert_allclose(brain.node_std(MESH.nodes, EVERY_COLUMN, wrong), direct_std(brain, wrong), rtol=2e-2)


def test_the_std_is_right_for_fields_drawn_from_the_model():
    """Weights and discrepancies are drawn from the prior, at the typical amplitude."""
    rng = np.random.default_rng(2)
    rms = np.sqrt(((M**2) @ (PRIOR.mean / PRIOR.mean.sum())).sum(axis=1))
    ratios = []
    for _ in range(24):
        weights = rng.multivariate_normal(PRIOR.mean, PRIOR.covariance_times(np.eye(12)))
        atlas_part = M @ weights
        shift = np.sqrt(np.mean(np.sum(atlas_part[POINTS] ** 2, axis=1)))
        size = discrepancy.TYPICAL_ERROR * local_shift(rms, rms[POINTS], shift) / np.sqrt(3.0)
        K = correlation(MESH.nodes, MESH.nodes) * np.outer(size, size)
        truth = atlas_part + np.linalg.cholesky(K + 1e-12 * np.eye(len(K))) @ rng.normal(size=(len(K), 3))
        brain = conditioned(truth[POINTS] + rng.normal(0.0, NOISE, (10, 3)))
        likely = PRIOR.mean + brain.with_points @ brain.deviation
        std = brain.node_std(MESH.nodes, EVERY_COLUMN, likely)
        ratios.append((truth - M @ likely) / std[:, None])
    assert np.mean(np.square(ratios)) == pytest.approx(1.0, abs=0.3)
    assert 0.91 < np.mean(np.abs(ratios) < 1.96) < 0.985


def test_an_estimate_that_leaves_what_is_likely_pays_for_it():
    weights = np.full(12, 0.8 / 12)
    brain = conditioned(M[POINTS] @ weights)
    own, doubled = (brain.node_std(MESH.nodes, EVERY_COLUMN, w) for w in (weights, 2.0 * weights))
    error = np.linalg.norm(M @ weights, axis=1) / np.sqrt(3.0)
    assert (doubled > own).mean() > 0.99
    assert np.median(doubled / error) > 0.9


def test_noise_beyond_the_stated_is_learnt():
    rng = np.random.default_rng(3)
    weights = np.full(12, 0.8 / 12)
    nodes = top_nodes(MESH, 24)
    honest, deceiving = (
        conditioned(M[nodes] @ weights + rng.normal(0.0, true, (24, 3)), nodes, noise=2e-4) for true in (2e-4, 2e-3)
    )
    assert honest.amplitudes.sigma_factor < 1.5
    assert 5.0 < deceiving.amplitudes.sigma_factor < 20.0


def test_the_likelihood_finds_the_amplitude_of_a_drawn_discrepancy():
    rng = np.random.default_rng(4)
    points = rng.normal(0.0, 0.03, (40, 3))
    K = np.kron(correlation(points, points) * 1e-4 / 3.0, np.eye(3))
    noise, nothing = 1e-8 * np.eye(120), 1e-12 * np.eye(120)
    found = []
    for factor in (0.5, 2.0):
        drawn = factor * discrepancy.TYPICAL_ERROR * np.linalg.cholesky(K + 1e-14 * np.eye(120)) @ rng.normal(size=120)
        found.append(likely_amplitudes(drawn + rng.normal(0.0, 1e-4, 120), nothing, noise, K).error)
    assert found[0] == pytest.approx(0.5 * discrepancy.TYPICAL_ERROR, rel=0.35)
    assert found[1] == pytest.approx(2.0 * discrepancy.TYPICAL_ERROR, rel=0.35)


def test_the_span_holds_every_column():
    span = atlas_span(ATLAS)
    assert span.fields.shape[2] <= 24
    error = np.linalg.norm(span.fields @ span.mixing - ATLAS.E)
    assert error < 0.01 * np.linalg.norm(ATLAS.E)
    for column in range(span.fields.shape[2]):
        distance = np.abs(ATLAS.E - span.fields[:, :, [column]]).max(axis=(0, 1))
        assert distance.min() == 0.0


def test_appended_columns_stand_for_themselves():
    retraction = np.random.default_rng(0).normal(size=(2, len(MESH.nodes), 3)).astype(np.float32)
    span = atlas_span(ATLAS).appended(retraction)
    np.testing.assert_allclose((span.fields @ span.mixing)[:, :, 12:], retraction.transpose(1, 2, 0), atol=1e-6)


@given(count=st.integers(1, 400), seed=st.integers(0, 99))
@settings(max_examples=12, deadline=None)
def test_gathered_points_are_few_and_keep_weighted_means(count, seed):
    rng = np.random.default_rng(seed)
    positions, rows = rng.normal(0.0, 0.03, (count, 3)), rng.normal(size=(count, 3, 2))
    displacements, sigma = rng.normal(size=(count, 3)), rng.uniform(1e-4, 1e-3, count)
    gathered = gather(positions, rows, displacements, sigma)
    assert len(gathered.positions) <= max(32, min(count, 32))
    # The information in the weighted mean over everything is kept.
    weight = 1.0 / np.diagonal(gathered.noise)
    assert weight.sum() == pytest.approx(np.sum(1.0 / sigma**2))
    mean = weight @ gathered.displacements.reshape(-1, 3) / weight.sum()
    np.testing.assert_allclose(mean, (1.0 / sigma**2) @ displacements / np.sum(1.0 / sigma**2), atol=1e-9)
    as_covariance = gather(positions, rows, displacements, np.diag(sigma**2))
    np.testing.assert_allclose(as_covariance.noise, gathered.noise, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(as_covariance.rows, gathered.rows, atol=1e-12)


@pytest.mark.parametrize("share", [0.2, 0.45])
def test_the_agreeing_half_holds_no_wrong_point(share):
    nodes = top_nodes(MESH, 20)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u = M[nodes] @ (rng.dirichlet(np.ones(12)) * 0.8) + rng.normal(0.0, NOISE, (20, 3))
        wrong = rng.choice(20, int(share * 20), replace=False)
        u[wrong] += [0.0, 0.004, 0.009]
        agreeing = agreeing_half(MESH.nodes[nodes], M[nodes], u, np.full(20, NOISE), ATLAS.groups)
        assert agreeing.sum() == 11
        assert not agreeing[wrong].any()

"""The estimate from atlas and points: accuracy, robustness, uncertainty, verdict, JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from field_cases import ellipsoid_mesh, sag, sagging_atlas, top_nodes

from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.inverse.accuracy import angular_error_deg, shift_correction_percent
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.methods import METHODS
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.inverse.shift_estimate import json_schema
from brainshift_ros.mesh.locate import PointLocator

MESH = ellipsoid_mesh(10)
ATLAS = sagging_atlas(MESH)
LOCATOR = PointLocator(MESH)


def mixture(weights=(0.5, 0.3)):
    return ATLAS.E[:, :, : len(weights)].astype(float) @ weights


def outside_truth(seed=0):
    """A sag that is no combination of the atlas's columns."""
    direction = np.random.default_rng(seed).normal([0.1, -1.0, -0.05], 0.1)
    return sag(MESH.nodes, direction / np.linalg.norm(direction), 0.009, 1.55)


def measure(truth, count=20, noise=0.0, seed=0, nodes=None):
    nodes = top_nodes(MESH, count, seed) if nodes is None else nodes
    rng = np.random.default_rng(seed + 100)
    u = truth[nodes] + rng.normal(size=(len(nodes), 3)) * noise
    return HomologousPoints(MESH.nodes[nodes], u, np.full(len(nodes), max(noise, 1e-4)))


def estimate(measured, **options):
    return estimate_shift(ATLAS, measured, options=InverseOptions(**options), locator=LOCATOR)


def error(result, truth):
    return np.linalg.norm(result.field.displacement - truth, axis=1)


def test_a_mixture_of_the_atlas_comes_back_exactly():
    truth = mixture()
    result = estimate(measure(truth))
    assert result.valid, result.reasons
    assert error(result, truth).max() < 1e-6
    assert result.correction_percent == pytest.approx(100.0, abs=0.01)
    assert result.solution.kkt_residual < 1e-10
    assert result.mechanism_sums["gravity"] == pytest.approx(0.8, abs=1e-3)
    assert result.field.provenance["patient_id"] == ATLAS.patient_id


@pytest.mark.parametrize("seed", range(4))
def test_a_shift_that_is_not_in_the_atlas_is_mostly_corrected_everywhere(seed):
    truth = outside_truth(seed)
    result = estimate(measure(truth, noise=5e-4, seed=seed))
    assert result.valid, result.reasons
    assert 1.0 - error(result, truth).mean() / np.linalg.norm(truth, axis=1).mean() > 0.85


def test_points_off_the_nodes_and_off_the_surface_are_interpolated():
    truth = mixture()
    nodes = top_nodes(MESH, 15)
    measured = measure(truth, nodes=nodes)
    shifted = replace(measured, points=measured.points + np.array([0.0, 0.003, 0.0]))
    result = estimate(shifted)
    assert result.valid
    assert error(result, truth).mean() < 1e-3


def test_rows_are_the_atlas_at_the_points():
    measured = measure(mixture(), 5)
    rows = rows_at_points(AppendedAtlas(ATLAS, None), measured, locator=LOCATOR)
    np.testing.assert_allclose(rows.M, ATLAS.E[top_nodes(MESH, 5)], atol=1e-9)
    inner = replace(measured, points=np.array([[0.0, 0.01, 0.005]] * 5))
    located = LOCATOR.locate(inner.points)
    expected = located.interpolate(MESH, ATLAS.E.astype(float))
    np.testing.assert_allclose(rows_at_points(AppendedAtlas(ATLAS, None), inner, locator=LOCATOR).M, expected, atol=1e-12)


def test_only_a_few_rows_and_columns_are_read():
    atlas = replace(ATLAS, reads=[])
    result = estimate_shift(atlas, measure(mixture()), locator=LOCATOR)
    reads = dict(atlas.reads)
    assert reads["rows"] <= 4 * 20
    assert reads["columns"] == len(result.weights)


def test_far_points_are_dropped_with_a_warning():
    measured = measure(mixture())
    points = measured.points.copy()
    points[:3] *= 1.5
    result = estimate(replace(measured, points=points))
    assert result.valid
    assert len(result.points) == 17
    assert any("3 of 20 points lie more than 5 mm outside" in warning for warning in result.warnings)


def test_clean_points_are_all_used():
    assert estimate(measure(outside_truth(), 30, noise=5e-4)).used.all()


def test_noisy_points_count_less():
    truth = mixture()
    measured = measure(truth, 24, noise=0.0)
    rng = np.random.default_rng(0)
    u, sigma = measured.displacements.copy(), np.full(24, 1e-4)
    u[:12] += rng.normal(size=(12, 3)) * 3e-3
    sigma[:12] = 3e-3
    honest = estimate(replace(measured, displacements=u, sigma=sigma))
    deceived = estimate(replace(measured, displacements=u, sigma=np.full(24, 3e-3)))
    assert error(honest, truth).mean() < 0.3 * error(deceived, truth).mean()


@pytest.mark.parametrize("seed", range(3))
def test_the_standard_deviation_covers_the_error(seed):
    truth = outside_truth(seed)
    result = estimate(measure(truth, noise=5e-4, seed=seed))
    components = np.abs(result.field.displacement - truth) / result.field.std[:, None]
    assert (components < 1.96).mean() > 0.9
    assert result.field.std.mean() < 0.5 * np.linalg.norm(truth, axis=1).mean()


def test_the_standard_deviation_grows_with_noise_and_falls_with_points():
    truth = mixture()
    few, many, noisy = (
        estimate(measure(truth, count, noise=noise)).field.std.mean() for count, noise in ((8, 1e-3), (36, 1e-3), (36, 3e-3))
    )
    assert many < few
    assert many < noisy


def retraction_columns():
    push = np.zeros((2, len(MESH.nodes), 3))
    push[0, :, 0] = 0.004 * np.exp(-((MESH.nodes[:, 1] - 0.05) ** 2) / 4e-4)
    push[1, :, 2] = 0.004 * np.exp(-((MESH.nodes[:, 1] - 0.05) ** 2) / 4e-4)
    return push.astype(np.float32)


def test_retraction_has_a_sum_of_its_own():
    columns = retraction_columns()
    truth = ATLAS.E[:, :, 0].astype(float) + 0.9 * columns[0]  # sums 1.0 and 0.9: over one in all
    result = estimate_shift(ATLAS, measure(truth, 24), retraction=columns, locator=LOCATOR)
    assert result.valid
    assert error(result, truth).max() < 1e-5
    assert result.mechanism_sums == pytest.approx({"gravity": 1.0, "retraction": 0.9}, abs=1e-3)
    assert {weight.column for weight in result.weights if weight.mechanism == "retraction"} == {40}
    assert result.retraction_sha256 is not None


def test_retraction_of_another_mesh_is_refused():
    with pytest.raises(InputError, match=r"retraction: has shape \(2, 5, 3\)"):
        estimate_shift(ATLAS, measure(mixture()), retraction=np.zeros((2, 5, 3), np.float32), locator=LOCATOR)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_a_field(method):
    truth = mixture()
    result = estimate(measure(truth, noise=1e-4), method=method)
    assert result.solution.method == method
    assert np.isfinite(result.field.displacement).all()
    assert np.isfinite(result.field.std).all()
    assert result.correction_percent > 80.0


def test_noise_only_points_do_not_pass_for_a_shift():
    rng = np.random.default_rng(0)
    measured = measure(mixture())
    result = estimate(replace(measured, displacements=rng.normal(size=(20, 3)) * 0.01, sigma=np.full(20, 5e-4)))
    assert not result.valid


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"points": np.zeros((0, 3)), "displacements": np.zeros((0, 3)), "sigma": np.zeros(0)}, "there are none"),
        ({"displacements": np.zeros((19, 3))}, r"displacements has shape \(19, 3\), not \(20, 3\)"),
        ({"displacements": np.full((20, 3), np.nan)}, "displacements holds values that are not finite"),
        ({"sigma": np.zeros(20)}, "sigma must be positive"),
    ],
)
def test_malformed_measurements_are_refused(changes, match):
    with pytest.raises(InputError, match=match):
        estimate(replace(measure(mixture()), **changes))


def test_json_follows_its_schema():
    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    columns = retraction_columns()
    results = [
        estimate(measure(outside_truth(), noise=5e-4)),
        estimate(measure(np.zeros_like(MESH.nodes))),
        estimate(measure(mixture(), 1)),
        estimate(measure(mixture()), method="tikhonov_gcv"),
        estimate_shift(ATLAS, measure(columns[0].astype(float), 24), retraction=columns, locator=LOCATOR),
    ]
    for result in results:
        text = json.dumps(result.to_json(), allow_nan=False)
        jsonschema.validate(json.loads(text), schema)
        assert result.to_json()["valid"] is (not result.to_json()["reasons"])
    broken = results[0].to_json() | {"correction_percent": 140.0}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(broken, schema)


def test_the_same_input_gives_the_same_estimate():
    a, b = (estimate(measure(outside_truth(), noise=5e-4)) for _ in range(2))
    np.testing.assert_array_equal(a.field.displacement, b.field.displacement)
    assert a.points_sha256 == b.points_sha256


def test_a_diagonal_covariance_is_the_same_as_sigma():
    measured = measure(outside_truth(), 24, noise=5e-4)
    by_sigma = estimate(measured)
    by_covariance = estimate_shift(ATLAS, measured, covariance=np.diag(measured.sigma**2), locator=LOCATOR)
    np.testing.assert_allclose(by_covariance.field.displacement, by_sigma.field.displacement, atol=1e-9)
    np.testing.assert_allclose(by_covariance.field.std, by_sigma.field.std, rtol=1e-6)


def test_errors_that_are_common_to_all_points_leave_more_uncertain():
    """A displacement common to all, as of a registration: the truth is within the deviation only if it is told so."""
    truth, measured = mixture(), measure(mixture(), 24, noise=2e-4)
    common = replace(measured, displacements=measured.displacements + np.array([0.0, -0.0012, 0.0]))
    covariance = 1e-3**2 * np.ones((24, 24)) + np.diag(measured.sigma**2)
    told = estimate_shift(ATLAS, common, covariance=covariance, locator=LOCATOR)
    assert told.used.all()
    assert told.field.std.mean() > 1.5 * estimate(common).field.std.mean()
    assert (np.abs(told.field.displacement - truth) < 1.96 * told.field.std[:, None]).mean() > 0.95


@pytest.mark.parametrize(
    ("covariance", "match"),
    [
        (np.eye(19), r"covariance has shape \(19, 19\), not \(20, 20\)"),
        (np.eye(20) + np.eye(20, k=1), "not symmetric"),
        (np.ones((20, 20)), "not positive definite"),
        (np.full((20, 20), np.nan), "not finite"),
    ],
)
def test_malformed_covariances_are_refused(covariance, match):
    with pytest.raises(InputError, match=match):
        estimate_shift(ATLAS, measure(mixture()), covariance=covariance, locator=LOCATOR)


def test_mechanisms_add_up_to_the_estimated_shift():
    columns = retraction_columns()
    truth = 0.6 * ATLAS.E[:, :, 0].astype(float) + 0.9 * columns[0]
    result = estimate_shift(ATLAS, measure(truth, 24), retraction=columns, locator=LOCATOR)
    assert set(result.mechanisms) == {"gravity", "retraction"}
    total = sum(share.shift for share in result.mechanisms.values())
    assert total == pytest.approx(np.linalg.norm(result.estimated, axis=1).mean())
    assert result.mechanisms["retraction"].weight_sum == pytest.approx(0.9, abs=1e-3)
    assert all(weight.std >= 0.0 for weight in result.weights)


def test_a_dense_measurement_is_estimated_too():
    truth = outside_truth()
    points = np.random.default_rng(0).uniform([-0.02, 0.035, -0.015], [0.02, 0.045, 0.015], (500, 3))
    u = LOCATOR.locate(points).interpolate(MESH, truth)
    rng = np.random.default_rng(1)
    dense = estimate(HomologousPoints(points, u + rng.normal(0.0, 5e-4, u.shape), np.full(500, 5e-4)))
    assert dense.valid
    assert dense.used.mean() > 0.99
    assert (np.abs(dense.field.displacement - truth) < 1.96 * dense.field.std[:, None]).mean() > 0.9


def test_the_largest_angle_is_told():
    result = estimate(measure(outside_truth(), noise=1e-3))
    assert result.angular_error_deg == pytest.approx(result.angles_deg.mean())
    assert result.to_json()["angular_error_max_deg"] == pytest.approx(result.angles_deg.max())
    assert result.angles_deg.max() > result.angles_deg.mean() > 0.0


def test_measures_of_agreement_by_hand():
    measured = np.array([[3.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    estimated = np.array([[3.0, 0.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
    assert shift_correction_percent(measured, estimated) == pytest.approx((1 - 3.0 / 7.0) * 100)
    assert angular_error_deg(measured, estimated) == pytest.approx(np.degrees(np.arctan2(2, 4)) / 2)


def test_entry_parameters_reach_the_weights():
    result = estimate(measure(mixture()))
    by_column = {weight.column: weight for weight in result.weights}
    entry: AtlasEntry = ATLAS.entries[0]
    assert by_column[0].gravity_direction == entry.gravity_direction
    assert by_column[0].fluid_level == entry.fluid_level


def test_the_field_knows_how_much_of_it_has_no_tumour():
    entries = tuple(replace(entry, resected=column == 0) for column, entry in enumerate(ATLAS.entries))
    result = estimate_shift(replace(ATLAS, entries=entries), measure(mixture((0.5, 0.3))), locator=LOCATOR)
    assert result.field.provenance["resected_share"] == pytest.approx(0.5 / 0.8, abs=0.01)
    assert estimate(measure(mixture())).field.provenance["resected_share"] == 0.0

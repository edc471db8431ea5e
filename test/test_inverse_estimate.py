"""The estimate from atlas and points: accuracy, robustness, uncertainty, verdict, JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from field_cases import MemoryAtlas, ellipsoid_mesh, sag, sagging_atlas, top_nodes

from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
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


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_are_dropped_and_said(share):
    truth = outside_truth()
    measured = measure(truth, 30, noise=5e-4)
    wrong = np.arange(int(share * 30))
    u = measured.displacements.copy()
    u[wrong] += np.random.default_rng(1).normal(size=(wrong.size, 3)) * 0.012 + [0.006, 0.006, 0.0]
    with_outliers, clean = estimate(replace(measured, displacements=u)), estimate(measured)
    assert not with_outliers.used[wrong].all()
    assert with_outliers.used[wrong.size :].mean() > 0.9
    assert any("outliers" in warning for warning in with_outliers.warnings)
    assert error(with_outliers, truth).mean() < error(clean, truth).mean() + 5e-4


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


def test_zero_shift_is_said():
    result = estimate(measure(np.zeros_like(MESH.nodes)))
    assert result.correction_percent is None
    assert result.angular_error_deg is None
    assert not result.field.displacement.any()
    assert any("not above its own noise" in warning for warning in result.warnings)


def test_a_shift_against_the_atlas_is_not_valid():
    result = estimate(measure(-mixture()))
    assert not result.valid
    assert result.weights == ()
    assert any("every weight is zero" in reason for reason in result.reasons)


def test_a_shift_against_the_atlas_is_not_valid_even_within_a_wide_sigma():
    measured = measure(-mixture())
    shift = np.linalg.norm(measured.displacements, axis=1).mean()
    result = estimate(replace(measured, sigma=np.full(20, shift / 2.5)))
    assert len(result.reasons) == 1
    assert "every weight is zero" in result.reasons[0]


def test_a_shift_beyond_the_atlas_saturates_and_is_said():
    result = estimate(measure(3.0 * ATLAS.E[:, :, int(np.argmax(np.abs(ATLAS.E).max(axis=(0, 1))))].astype(float)))
    assert result.solution.saturated == ("gravity",)
    assert any("reached their limit" in warning for warning in result.warnings)
    assert not result.valid


@pytest.mark.parametrize("count", [1, 3, 4])
def test_too_few_points_are_not_valid(count):
    result = estimate(measure(mixture(), count))
    assert not result.valid
    assert any(f"{count} points in use, 5 are needed" in reason for reason in result.reasons)
    assert np.isfinite(result.field.std).all()


def test_points_on_a_line_or_in_a_corner_are_said():
    line = np.linspace([-0.02, 0.054, 0.0], [0.02, 0.054, 0.0], 8)
    u = LOCATOR.locate(line, 0.01).interpolate(MESH, mixture())
    on_line = estimate(HomologousPoints(line, u, np.full(8, 1e-4)))
    assert any("nearly on a line" in warning for warning in on_line.warnings)
    corner = line[:1] + np.random.default_rng(0).normal(size=(8, 3)) * 1e-3
    u = LOCATOR.locate(corner, 0.01).interpolate(MESH, mixture())
    in_corner = estimate(HomologousPoints(corner, u, np.full(8, 1e-4)))
    assert any("patch of only" in warning for warning in in_corner.warnings)


def test_points_of_another_patient():
    measured = measure(mixture())
    with pytest.raises(InputError, match=r"none of 20 points lies within 5 mm of the brain \(nearest: \d+ mm\)"):
        estimate(replace(measured, points=measured.points + np.array([0.3, 0.0, 0.0])))
    points = measured.points.copy()
    points[:13] += [0.3, 0.0, 0.0]
    partly = estimate(replace(measured, points=points))
    assert not partly.valid
    assert any("another patient" in reason for reason in partly.reasons)


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


def test_an_atlas_of_one_column_and_one_with_duplicates():
    one = MemoryAtlas(MESH, ATLAS.E[:, :, :1], ATLAS.entries[:1], (WeightGroup("gravity", (0,)),))
    result = estimate_shift(one, measure(0.7 * ATLAS.E[:, :, 0]), locator=LOCATOR)
    assert result.weights[0].weight == pytest.approx(0.7, abs=1e-3)
    twice = MemoryAtlas(MESH, np.repeat(ATLAS.E, 2, axis=2), ATLAS.entries * 2, (WeightGroup("gravity", tuple(range(80))),))
    doubled = estimate_shift(twice, measure(outside_truth()), locator=LOCATOR)
    single = estimate(measure(outside_truth()))
    np.testing.assert_allclose(doubled.field.displacement, single.field.displacement, atol=1e-6)


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

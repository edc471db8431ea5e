"""Homologous points against the simulator's truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulation_cases import SMALL_SCANNER, scan_case

from brainshift_ros.correspondence.lifting import lift
from brainshift_ros.correspondence.outliers import consistent_points
from brainshift_ros.correspondence.tracking import TrackingOptions, prepare_first, track
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.simulation.scanner import scanner_pose, take_scan
from brainshift_ros.units import m_to_mm


def cortex_of(simulated):
    return np.isfinite(simulated.current).all(axis=-1) & simulated.scan.seen


def error_of(case, tracking):
    """Error vectors (n, 3) in millimetres, patient frame, and errors over sigma."""
    points = transform_points(case.T_patient_tracker, tracking.points.points)
    displacement = tracking.points.displacements @ case.T_patient_tracker[:3, :3].T
    error = displacement - case.shift(points)
    return m_to_mm(error), error / tracking.points.sigma[:, None]


CASES = [(1, 3.0), (2, 8.0), (3, 12.0), (4, 15.0)]


def tracked(seed, peak_mm):
    case = scan_case(seed, peak_mm)
    options = TrackingOptions(tracker_mm=0.0)  # the tracker is exact here
    return case, track(prepare_first(case.first.scan, cortex_of(case.first)), case.later.scan, options)


@pytest.mark.parametrize(("seed", "peak_mm"), CASES)
def test_points_are_many_spread_and_exact(seed, peak_mm):
    case, tracking = tracked(seed, peak_mm)
    length = np.linalg.norm(error_of(case, tracking)[0], axis=1)
    assert len(length) >= 40
    assert np.median(length) < 0.35
    assert np.quantile(length, 0.95) < 1.2
    assert length.max() < 3.0
    local = transform_points(case.scene.craniotomy.T_craniotomy_patient @ case.T_patient_tracker, tracking.points.points)
    quadrants = {(x > 0, y > 0) for x, y, _ in local}
    assert len(quadrants) == 4
    moved = np.linalg.norm(tracking.points.displacements, axis=1)
    assert m_to_mm(moved.max()) > 0.6 * peak_mm


def test_about_two_thirds_of_the_errors_lie_within_one_sigma():
    scaled = np.concatenate([error_of(*tracked(seed, peak_mm))[1] for seed, peak_mm in CASES])
    assert 0.60 < np.mean(np.abs(scaled) < 1.0) < 0.76
    assert np.mean(np.abs(scaled) < 3.0) > 0.92


def test_sigma_knows_the_bad_points():
    lengths, sigmas = [], []
    for seed, peak_mm in CASES:
        case, tracking = tracked(seed, peak_mm)
        lengths.append(np.linalg.norm(error_of(case, tracking)[0], axis=1))
        sigmas.append(tracking.points.sigma)
    length, sigma = np.concatenate(lengths), np.concatenate(sigmas)
    doubtful = sigma > np.quantile(sigma, 0.8)
    assert np.mean(length[doubtful]) > 1.5 * np.mean(length[~doubtful])


def test_a_scan_against_itself_does_not_move():
    case = scan_case(1, 3.0)
    first = prepare_first(case.first.scan, cortex_of(case.first))
    again = track(first, case.first.scan)
    assert len(again.points.points) > 0.9 * len(first.candidates)
    assert np.abs(again.points.displacements).max() < 0.02e-3


def test_a_moved_scanner_is_no_shift():
    case = scan_case(1, 3.0)
    pose = scanner_pose(case.scene.craniotomy, SMALL_SCANNER, 12.0, 200.0, 30.0)
    other = take_scan(case.scene, case.T_patient_tracker, pose, seed=77, scanner=SMALL_SCANNER)
    tracking = track(prepare_first(case.first.scan, cortex_of(case.first)), other.scan)
    length = m_to_mm(np.linalg.norm(tracking.points.displacements, axis=1))
    assert len(length) >= 20
    assert np.median(length) < 0.4
    assert np.quantile(length, 0.95) < 2.0


def test_a_third_of_the_later_scan_missing():
    case = scan_case(2, 8.0)
    scanner = replace(SMALL_SCANNER, dropout_fraction=0.3)
    pose = scanner_pose(case.scene.craniotomy, scanner, 8.0, 20.0, 0.0)
    later = take_scan(case.scene, case.T_patient_tracker, pose, seed=9, displacement=case.shift, scanner=scanner)
    tracking = track(prepare_first(case.first.scan, cortex_of(case.first)), later.scan)
    length = np.linalg.norm(error_of(case, tracking)[0], axis=1)
    assert len(length) >= 40
    assert np.median(length) < 0.4
    assert np.quantile(length, 0.95) < 1.2


def test_another_brain_gives_a_warning_and_next_to_no_points():
    case, other = scan_case(1, 3.0), scan_case(2, 8.0)
    foreign = transform_points(np.linalg.inv(case.T_patient_tracker) @ other.T_patient_tracker, other.later.scan.points)
    tracking = track(
        prepare_first(case.first.scan, cortex_of(case.first)), replace(other.later.scan, points=foreign.astype(np.float32))
    )
    assert len(tracking.points.points) < 10
    assert tracking.warnings


def test_a_later_scan_without_anything_in_place_gives_no_points():
    case = scan_case(1, 3.0)
    away = replace(case.later.scan, points=case.later.scan.points + np.float32(0.5))
    tracking = track(prepare_first(case.first.scan, cortex_of(case.first)), away)
    assert len(tracking.points.points) == 0
    assert tracking.points.points.shape == (0, 3)
    assert tracking.warnings


def test_a_cortex_without_features_is_refused():
    case = scan_case(1, 3.0)
    plain = np.full_like(case.first.scan.rgb, 150)
    with pytest.raises(InputError, match="vessel features"):
        prepare_first(replace(case.first.scan, rgb=plain), cortex_of(case.first))


def test_the_same_scans_give_the_same_points():
    case = scan_case(1, 3.0)
    one, two = (track(prepare_first(case.first.scan, cortex_of(case.first)), case.later.scan).points for _ in range(2))
    np.testing.assert_array_equal(one.points, two.points)
    np.testing.assert_array_equal(one.displacements, two.displacements)
    np.testing.assert_array_equal(one.sigma, two.sigma)


def test_lifting_is_exact_on_a_quadratic_and_beats_the_noise():
    cell = 0.2e-3
    rows, columns = np.indices((60, 60))

    def surface(x, y):
        return 0.01 + 0.3 * x - 0.2 * y + 8.0 * x**2 - 5.0 * x * y

    height = surface(columns * cell, rows * cell)
    at = np.array([[20.3, 31.8], [40.0, 22.5]])
    points, _ = lift(height.astype(np.float64), at, cell)
    np.testing.assert_allclose(points[:, 2], surface(at[:, 0] * cell, at[:, 1] * cell), atol=1e-8)
    noisy = height + np.random.default_rng(0).normal(0, 0.3e-3, height.shape)
    lifted, noise = lift(noisy, at, cell)
    assert np.abs(lifted[:, 2] - points[:, 2]).max() < 0.15e-3
    assert (noise > 0.01e-3).all()
    assert (noise < 0.15e-3).all()
    height[:, 25:] = np.nan
    assert np.isnan(lift(height, at, cell)[0][1]).all()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(3.0, 15.0))
def test_one_gross_outlier_in_an_affine_shift_is_removed_alone(seed, outlier_mm):
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-0.03, 0.03, (40, 2)), np.zeros((40, 1))], axis=1)
    shift = points @ rng.normal(0, 0.05, (3, 3)) + rng.normal(0, 5e-3, 3) + rng.normal(0, 0.05e-3, points.shape)
    worst = int(np.argmin(np.linalg.norm(points, axis=1)))
    direction = rng.normal(size=3)
    shift[worst] += outlier_mm * 1e-3 * direction / np.linalg.norm(direction)
    kept = consistent_points(points, shift, np.full(40, 0.1e-3))
    assert not kept[worst]
    assert kept.sum() >= 37

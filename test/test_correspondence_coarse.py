"""The parts of the correspondence: agreement of matches, smooth fields, obstacles, coverage, standard deviations."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainshift_ros.correspondence.coarse_match import agreeing, match_features
from brainshift_ros.correspondence.coverage import far_share
from brainshift_ros.correspondence.features import Features
from brainshift_ros.correspondence.obstacles import find_obstacles
from brainshift_ros.correspondence.outliers import disagreement
from brainshift_ros.correspondence.plane_view import PlaneImage
from brainshift_ros.correspondence.point_sigma import PointEvidence, point_sigma
from brainshift_ros.correspondence.smooth_field import field_through, fit_field, fit_similarity

CELL_M = 0.2e-3


def turned(points, degrees, shift):
    angle = np.deg2rad(degrees)
    return points @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) + shift


def test_a_coherent_wrong_cluster_is_not_kept_beside_the_right_one():
    rng = np.random.default_rng(0)
    right, wrong, noise = rng.uniform(0.0, 0.04, (80, 2)), rng.uniform(0.0, 0.012, (25, 2)), rng.uniform(0.0, 0.04, (30, 2))
    wrong += [0.030, 0.0]  # where hardly anything else is
    right = right[(right[:, 0] < 0.022) | (right[:, 1] > 0.02)]
    first = np.concatenate([right, wrong, noise])
    # The right ones turn with the brain; the wrong ones, say an instrument's reflection, stay where they are.
    later = np.concatenate([turned(right, 15.0, [0.012, -0.006]), wrong, rng.uniform(0.0, 0.04, (30, 2))])
    turn = np.concatenate([np.full(len(right), np.deg2rad(15.0)), np.zeros(25), rng.uniform(-0.7, 0.7, 30)])
    turn += rng.normal(0.0, np.deg2rad(8.0), len(turn))
    kept = agreeing(first, later, turn, connected=True)
    assert kept[: len(right)].mean() > 0.9
    assert not kept[len(right) : len(right) + 25].any()
    assert kept[len(right) + 25 :].mean() < 0.1


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_matches_at_random_never_agree(seed):
    rng = np.random.default_rng(seed)
    first, later = rng.uniform(0.0, 0.05, (2, 80, 2))
    assert agreeing(first, later, rng.uniform(-0.8, 0.8, 80), connected=True).sum() < 10


@pytest.mark.parametrize("degrees", [0.0, 25.0])
def test_features_are_matched_by_what_they_look_like(degrees):
    rng = np.random.default_rng(3)
    at, turn = rng.uniform(0.0, 200.0, (60, 2)), rng.uniform(-np.pi, np.pi, 60)
    looks = rng.uniform(0.0, 150.0, (60, 128)).astype(np.float32)
    order = rng.permutation(60)
    later = Features(
        turned(at, degrees, [20.0, 10.0])[order],
        (turn + np.deg2rad(degrees))[order],
        looks[order] + rng.normal(0.0, 5.0, looks.shape).astype(np.float32),
    )
    matches = match_features(Features(at, turn, looks), later, CELL_M, reach_m=35e-3, turn_rad=np.deg2rad(45.0))
    assert len(matches.first) > 50
    np.testing.assert_allclose(matches.later, turned(matches.first, degrees, [20.0, 10.0]))
    far = match_features(Features(at, turn, looks), later, CELL_M, reach_m=1e-3, turn_rad=np.deg2rad(45.0))
    assert len(far.first) == 0


@settings(max_examples=25, deadline=None)
@given(st.floats(-180.0, 180.0), st.floats(0.85, 1.2), st.integers(0, 1000))
def test_similarity_is_the_one_of_opencv(degrees, scale, seed):
    rng = np.random.default_rng(seed)
    source = rng.uniform(0.0, 400.0, (12, 2))
    target = turned(source, degrees, [30.0, -12.0]) * scale
    np.testing.assert_allclose(fit_similarity(source, target), cv2.estimateAffinePartial2D(source, target)[0], atol=1e-3)


def test_three_pairs_give_a_similarity_and_its_field_is_exact_over_the_grid():
    places = np.array([[20.0, 30.0], [150.0, 40.0], [80.0, 160.0]])
    field = field_through(places, turned(places, 50.0, [60.0, -20.0]), CELL_M)
    rows, columns = np.indices((181, 203))
    everywhere = np.stack([columns, rows], axis=-1).astype(np.float64)
    expected = turned(everywhere, 50.0, [60.0, -20.0]) - everywhere
    np.testing.assert_allclose(field.over((181, 203)), expected, atol=0.01)


def test_a_spline_follows_a_smooth_shift_between_its_places():
    rng = np.random.default_rng(5)
    places, asked = rng.uniform(0.0, 300.0, (150, 2)), rng.uniform(30.0, 270.0, (60, 2))

    def shift(at):
        return np.stack([12.0 * np.exp(-0.5 * np.sum((at - 150.0) ** 2, axis=1) / 100.0**2), 0.05 * at[:, 0]], axis=-1)

    field = fit_field(places, shift(places), CELL_M, 0.002)
    np.testing.assert_allclose(field(asked), shift(asked), atol=0.15)


def test_metal_drape_blood_and_a_step_are_obstacles_but_vessels_and_shade_are_not():
    shape = (300, 300)
    cortex, vessel = np.array([190.0, 130.0, 110.0]), np.array([110.0, 30.0, 28.0])
    rng = np.random.default_rng(2)
    color = np.tile(cortex, (*shape, 1)) * np.linspace(1.1, 0.35, 300)[:, None, None]  # light falls off
    color[:, 60:70] = vessel  # 2 mm wide
    color[40:80, 150:190] = [105.0, 105.0, 108.0]  # metal
    color[120:160, 150:190] = [40.0, 100.0, 110.0]  # drape
    color[200:240, 150:190] = [100.0, 16.0, 16.0]  # a pool of blood
    color += rng.normal(0.0, 3.0, color.shape)
    height = np.tile(np.linspace(0.0, 10e-3, 300), (300, 1))
    height[:, 250:] -= 8e-3  # the floor of a cavity
    image = PlaneImage(color.astype(np.float32), np.ones(shape, bool), height.astype(np.float32))
    for lamp in ([1.0, 1.0, 1.0], [1.15, 1.0, 0.8], [0.85, 1.0, 1.2]):
        lit = PlaneImage((image.color * np.array(lamp)).astype(np.float32), image.matte, image.height)
        obstacles = find_obstacles(lit, np.ones(shape, bool), CELL_M).cells
        for patch in ((40, 80), (120, 160), (200, 240)):
            assert obstacles[patch[0] : patch[1], 150:190].mean() > 0.97
        assert obstacles[:, 249:252].all()
        assert obstacles[:, 10:140].mean() < 0.02
        assert obstacles[:, 270:].mean() < 0.02


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_blood_that_covers_most_of_the_opening_is_not_taken_for_cortex(share):
    shape = (200, 200)
    rng = np.random.default_rng(8)

    def image(covered, lamp):
        color = np.tile(np.array([190.0, 130.0, 110.0]), (*shape, 1))
        color[: round(covered * shape[0])] = [115.0, 14.0, 14.0]
        color = color * lamp + rng.normal(0.0, 3.0, color.shape)
        return PlaneImage(color.astype(np.float32), np.ones(shape, bool), np.zeros(shape, np.float32))

    opening = np.ones(shape, bool)
    first = find_obstacles(image(0.0, np.ones(3)), opening, CELL_M)
    assert first.cortex_redness == pytest.approx(np.log(198.0 / 138.0), abs=0.03)
    assert first.cells.mean() < 0.02
    later = find_obstacles(image(share, np.array([1.1, 1.0, 0.9])), opening, CELL_M, first.cortex_redness)
    assert later.cells.mean() == pytest.approx(share, abs=0.03)


def test_half_a_square_is_far_from_points_on_one_side():
    region = np.ones((400, 400), dtype=bool)  # 80 mm square
    rows = np.arange(5.0, 400.0, 10.0)
    on_the_left = np.stack([np.zeros_like(rows), rows], axis=-1)
    assert far_share(region, on_the_left, CELL_M) == pytest.approx(65.0 / 80.0, abs=0.01)
    assert far_share(region, np.zeros((0, 2)), CELL_M) == 1.0
    everywhere = np.stack(np.meshgrid(rows, rows), axis=-1).reshape(-1, 2)
    assert far_share(region, everywhere, CELL_M) == 0.0


def test_a_turn_of_the_whole_cortex_is_no_disagreement():
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-0.03, 0.03, (60, 2)), rng.normal(0.0, 2e-3, 60)])
    moved = np.column_stack([turned(points[:, :2], 60.0, [0.01, 0.0]), points[:, 2]])
    assert disagreement(points, moved - points).max() < 0.02e-3
    moved[10] += [0.0, 1e-3, 0.0]
    far_off = disagreement(points, moved - points)
    assert far_off[10] == pytest.approx(1e-3, rel=0.15)
    assert np.median(np.delete(far_off, 10)) < 0.05e-3
    assert np.isnan(disagreement(points[:5], moved[:5])).all()


def test_sigma_grows_with_each_kind_of_evidence_and_holds_the_tracker():
    quiet = PointEvidence(*(np.array([1e-10]) for _ in range(3)))
    floor = point_sigma(quiet, 0.3e-3)[0]
    assert floor == pytest.approx(0.3e-3 * np.sqrt(2.0 / 3.0), rel=0.01)
    for name in ("shift_variance", "lift_variance", "disagreement_m"):
        worse = PointEvidence(**{**vars(quiet), name: np.array([0.4e-3 if name.endswith("_m") else 0.16e-6])})
        assert point_sigma(worse, 0.3e-3)[0] > 1.1 * floor
    alone = PointEvidence(**{**vars(quiet), "disagreement_m": np.array([np.nan])})
    assert point_sigma(alone, 0.3e-3)[0] > 1.1 * floor

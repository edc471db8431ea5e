"""Scores of traced vessels, and the parts of the study of dense fields, on cases that are known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from mechanics_cases import head, patient

from brainshift_ros.correspondence.dense import DenseField, interpolate
from brainshift_ros.correspondence.error_growth import ErrorGrowth
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.dense_field import chart, summary_of
from brainshift_ros.experiments.dense_field_inverse import METHODS
from brainshift_ros.experiments.dense_field_scans import Interpolated, summary, table
from brainshift_ros.experiments.skull_cases import SKULLS, build_memory_atlas
from brainshift_ros.experiments.vessels_score import DRAWN_WIDER_M, PaintedTruth, score_tree
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.simulation.texture import paint_texture
from brainshift_ros.simulation.vessels import PaintedVessel
from brainshift_ros.units import mm_to_m
from brainshift_ros.vessels.tracing import VesselPath, VesselTree

PIXEL_M = 0.2e-3


def truth_of_a_cross():
    """A vessel of 1 mm along a row and a branch of 0.5 mm that leaves it downwards."""
    v, u = np.indices((100, 120))
    xy = np.stack([u, v], axis=-1) * PIXEL_M
    along, down = np.arange(10.0, 110.0, 0.5), np.arange(30.0, 90.0, 0.5)
    lines = np.concatenate([np.stack([along, np.full(200, 30.0)], axis=-1), np.stack([np.full(120, 60.0), down], axis=-1)])
    width = np.repeat([1.0e-3, 0.5e-3], [200, 120])
    judged = np.ones((100, 120), dtype=bool)
    return PaintedTruth(xy, judged, lines * PIXEL_M, width, np.array([[60.0, 30.0]]) * PIXEL_M, np.zeros((0, 2)))


def tree_of(*paths, branch_points=((30.0, 60.0),)):
    made = tuple(VesselPath(np.array(p, dtype=float), np.full(len(p), w), 1.0, False) for p, w in paths)
    return VesselTree(
        made, np.array(branch_points, dtype=float).reshape(-1, 2), np.zeros((0, 2)), np.zeros((100, 120)), PIXEL_M
    )


TRUNK = [(30, c) for c in range(10, 110)]
BRANCH = [(r, 60) for r in range(30, 90)]


def test_a_perfect_tree_scores_one():
    score = score_tree(tree_of((TRUNK, 1.0e-3), (BRANCH, 0.5e-3)), truth_of_a_cross())
    for key in ("recall", "precision", "branch_recall", "branch_precision"):
        assert score[key] == 1.0
    assert score["width_error_mm"] == pytest.approx(0.0, abs=1e-9)


def test_what_is_missing_and_what_is_too_much_shows():
    ghost = [(80, c) for c in range(10, 50)]
    score = score_tree(
        tree_of((TRUNK, 1.3e-3), (ghost, 0.5e-3), branch_points=((80.0, 20.0), (31.0, 58.0))), truth_of_a_cross()
    )
    assert score["recall"] == pytest.approx(200 / 320, abs=0.02)
    assert score["recall, < 0.6 mm"] < 0.1
    assert score["recall, to 1.3 mm"] == 1.0
    assert score["precision"] == pytest.approx(100 / 140)
    assert score["branch_recall"] == 1.0
    assert score["branch_precision"] == 0.5
    assert score["width_error_mm"] == pytest.approx(0.3)


def test_pixels_of_painted_vessels_are_as_wide_as_they():
    mask = truth_of_a_cross().on_vessel()
    assert mask[:, 20].sum() == 5
    assert mask[60].sum() == pytest.approx(2.5, abs=0.6)


@pytest.mark.parametrize("width_m", [0.4e-3, 0.6e-3, 1.0e-3, 1.6e-3])
def test_drawn_vessels_are_as_much_wider_as_the_score_says(width_m):
    along = np.arange(-18e-3, 18e-3, 0.4e-3)
    vessel = PaintedVessel(np.stack([along, 0.4 * along], axis=-1), np.full(len(along), width_m), True, 0)
    with_it, without = (paint_texture(v, np.zeros((9, 9)), 25e-3, np.random.default_rng(0)) for v in ((vessel,), ()))
    cover = ((without.image - with_it.image) / without.image)[..., 1]
    center = 0.5 * (len(cover) - 1)
    place, across = np.arange(-10e-3, 10e-3, 0.3e-3)[:, None], np.arange(-2e-3, 2e-3, 0.01e-3)
    unit = np.array([1.0, 0.4]) / np.hypot(1.0, 0.4)
    x, y = (place * unit[0] - across * unit[1], place * unit[1] + across * unit[0])
    at = [(part / with_it.pixel_m + center).astype(np.float32) for part in (x, y)]
    profile = cv2.remap(cover, *at, cv2.INTER_LINEAR).mean(axis=0)
    drawn = 0.01e-3 * np.sum(profile > 0.5 * profile.max())
    assert drawn - width_m == pytest.approx(DRAWN_WIDER_M, abs=0.13e-3)


@pytest.fixture(scope="module")
def small_atlas():
    mesh = head(6)
    model = patient(replace(mesh, nodes=mesh.nodes + mm_to_m([-35.0, 45.0, 50.0]) + 0.06 * np.array([0.0, -0.94, -0.34])))
    system = assemble_system(model.mesh, material_of(model.tissue))
    atlas, _ = build_memory_atlas(
        {False: system}, (0.0, -0.94, -0.34), np.radians(20.0), 3, (0.4, 0.6), SKULLS["free, high cap"]
    )
    return atlas, PointLocator(atlas.mesh)


@pytest.fixture(scope="module")
def dense(small_atlas):
    """A dense field of what the atlas can do, and the field itself."""
    atlas, _ = small_atlas
    rng = np.random.default_rng(0)
    truth = atlas.columns([1, 4]) @ np.array([0.6, 0.4])
    skull = np.unique(atlas.mesh.facets["skull"])
    center = mm_to_m([-35.0, 45.0, 50.0])
    near = skull[np.argsort(np.linalg.norm(atlas.mesh.nodes[skull] - center, axis=1))[:25]]
    measured = HomologousPoints(atlas.mesh.nodes[near], truth[near] + rng.normal(0, 0.1e-3, (25, 3)), np.full(25, 0.1e-3))
    # Nodes are double where the falx reaches the skull.
    return interpolate(measured, np.unique(atlas.mesh.nodes[near], axis=0)), truth


#: Every point counts: an outlier would hide what the weights do.
ALL_POINTS = InverseOptions(outlier_sigmas=1e6)


def test_without_correlation_the_covariance_is_the_sigmas(small_atlas, dense):
    atlas, locator = small_atlas
    alone = _without_correlation(dense[0])
    by_covariance, by_sigma = (
        estimate_shift(atlas, alone.as_points(), options=ALL_POINTS, covariance=covariance, locator=locator).field.displacement
        for covariance in (alone.covariance(0.0), None)
    )
    np.testing.assert_allclose(by_covariance, by_sigma, atol=1e-6)


def test_the_correlated_fit_finds_a_truth_of_the_atlas(small_atlas, dense):
    atlas, locator = small_atlas
    field, truth = dense
    covariance = field.covariance(0.2e-3)
    found = estimate_shift(atlas, field.as_points(), options=ALL_POINTS, covariance=covariance, locator=locator)
    assert np.linalg.norm(found.field.displacement - truth, axis=1).mean() < 0.1 * np.linalg.norm(truth, axis=1).mean()


def _without_correlation(field: DenseField) -> DenseField:
    growth = replace(field.growth, correlation_m=1e-9)
    weights = np.eye(len(field.points))
    sigma = np.hypot(growth.sigma(field.distance_m), 0.1e-3)
    return replace(
        field, growth=growth, weights=weights, measured_sigma=np.full(len(weights), 0.1e-3), sigma=sigma, common_m=0.0
    )


def test_the_table_counts_what_lies_within_a_sigma():
    rng = np.random.default_rng(0)
    distance = rng.uniform(0.0, 0.02, 4000)
    sigma = np.full(4000, 0.5e-3)
    item = Interpolated(3, "all points", 40, distance, sigma, rng.normal(0.0, 0.5e-3, (4000, 3)), ErrorGrowth())
    rows = table([item])
    assert sum(row["dense_points"] for row in rows) == 4000
    assert [row["within_one_sigma"] for row in rows] == pytest.approx([0.683] * len(rows), abs=0.05)
    assert [row["error_mm_p68"] for row in rows] == pytest.approx([0.5] * len(rows), rel=0.1)
    assert summary([item])["all points"]["within_two_sigma"] == pytest.approx(0.954, abs=0.01)


def test_the_summary_holds_means_over_truths():
    rows = [
        {"seed": seed, "coverage": coverage, "method": method, "group": "deep", "shift_mm": 4.0, "error_mm": seed + 1.0}
        | {"correction_percent": 100.0 * (1.0 - (seed + 1.0) / 4.0)}
        for seed in (0, 1)
        for coverage in ("even", "one-sided")
        for method in METHODS
    ]
    told = summary_of(rows)
    assert told["truths"] == 2
    assert told["error_mm"]["one-sided"][METHODS[0]] == {"deep": 1.5}
    assert told["correction_percent"]["even"][METHODS[-1]] == {"deep": 62.5}
    assert len(chart(rows).axes) == 2

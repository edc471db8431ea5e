"""Studies `uncertainty` and `outliers`: what they count, on errors that are known, and their charts."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments import outliers, uncertainty
from brainshift_ros.experiments.uncertainty_cases import TUNING_SEEDS, Scored, distance_name, kind_of, varied_truth

BIN = distance_name(0.0, 5.0)


def scored(method, group, points, scale, seed=0):
    """Standard normal errors, `scale` times as large as stated."""
    ratio = np.abs(np.random.default_rng(seed).normal(0.0, scale, 4000)).astype(np.float32)
    labels = {"seed": seed, "truth": "gravity", "resected": False, "points": points, "noise_mm": 0.5, "method": method}
    return Scored(labels | {"group": group, "targets": 4000}, ratio, error_mm=0.5 * scale, std_mm=0.5)


ITEMS = [
    scored(method, group, points, scale)
    for method, scale in (("constrained", 1.0), ("least_squares", 2.0))
    for points in (8, 24)
    for group in (*uncertainty.GROUPS, BIN)
]


def test_coverage_of_normal_errors():
    summary = uncertainty.summary_of([uncertainty.row_of(item) for item in ITEMS])
    assert summary["all_groups"]["estimates"] == 2 * len(uncertainty.GROUPS)
    for part in (summary["all_groups"], *summary["by_group"].values(), summary["by_distance"][BIN]):
        assert part["within_68"] == pytest.approx(0.683, abs=0.03)
        assert part["within_95"] == pytest.approx(0.950, abs=0.02)
    doubled = summary["by_method"]["least_squares"]
    assert doubled["within_68"] == pytest.approx(0.383, abs=0.03)
    assert (doubled["error_mm"], doubled["std_mm"]) == pytest.approx((1.0, 0.5))


def test_the_chart_of_coverage_has_every_part():
    figure = uncertainty.chart(ITEMS, [uncertainty.row_of(item) for item in ITEMS])
    assert len(figure.axes) == 7
    _, reliability, *_ = figure.axes
    curve = reliability.get_lines()[1].get_xydata()
    np.testing.assert_allclose(curve[:, 0], curve[:, 1], atol=3.0)


def test_truths_of_the_study_are_not_those_it_was_tuned_on():
    assert not set(uncertainty.MORE_SEEDS) & set(TUNING_SEEDS)
    assert not set(outliers.MORE_SEEDS) & set(TUNING_SEEDS)
    kinds = {kind_of(varied_truth(seed)) for seed in uncertainty.SEEDS}
    assert kinds == {"gravity", "gravity and mannitol", "finite strain", "free cap"}


def grid_points():
    x, y = np.meshgrid(np.linspace(0.0, 0.05, 5), np.linspace(0.0, 0.05, 5))
    return HomologousPoints(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), np.zeros((25, 3)), np.full(25, 1e-3))


@pytest.mark.parametrize("kind", outliers.KINDS)
def test_spoiled_points(kind):
    points = grid_points()
    found, wrong = outliers.spoiled(points, kind, 0.4, 0.006, np.random.default_rng(0))
    assert wrong.sum() == 10
    np.testing.assert_allclose(np.linalg.norm(found.displacements[wrong], axis=1), 0.006)
    assert not found.displacements[~wrong].any()
    assert not points.displacements.any()
    alike = bool(np.allclose(found.displacements[wrong], found.displacements[wrong][0]))
    reach = np.ptp(points.points[wrong], axis=0).max()
    assert (alike, reach < 0.05) == (kind == "clustered", kind == "clustered")


def spoiled_row(kind, size, share, fit, surface):
    numbers = {"surface_mm": surface, "subsurface_mm": surface, "deep_mm": surface}
    counts = {"wrong": round(24 * share), "wrong_dropped": 0, "right_dropped": 0, "valid": share < 0.5, "said": True}
    return {"seed": 0, "kind": kind, "size_mm": size, "share": share, "fit": fit, **numbers, **counts}


def test_the_bearable_share_ends_where_the_error_first_grows():
    errors = {0.0: 1.0, 0.1: 1.1, 0.2: 1.4, 0.3: 1.6, 0.4: 1.2, 0.5: 3.0}
    rows = [
        spoiled_row(kind, size, share, fit, errors[share])
        for kind in outliers.KINDS
        for size in outliers.SIZES_MM
        for share in outliers.SHARES
        for fit in outliers.FITS
    ]
    summary = outliers.summary_of(rows)
    assert set(summary["holds_up_to_share"].values()) == {0.2}
    assert summary["valid_share_at_largest_share"] == 0.0
    assert len(outliers.chart(rows).axes) == 6

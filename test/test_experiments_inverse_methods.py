"""The comparison of inverse methods: its estimates on a truth that is known, and its verdict on made-up tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mechanics_cases import head, patient

from brainshift_ros.experiments import inverse_methods_chart as charts
from brainshift_ros.experiments.inverse_methods import (
    asked_line,
    by_method,
    comparison_table,
    signed_rank_tests,
    summary_of,
    thesis_line,
)
from brainshift_ros.experiments.inverse_methods_cases import (
    BEST_CONSTRAINED,
    CONSTRAINED,
    LEAST_SQUARES,
    MEAN,
    METHODS,
    NO_LIMIT,
    NOTHING,
    SHIPPED,
    Comparison,
)
from brainshift_ros.experiments.inverse_methods_kinds import CONTACT, kinds
from brainshift_ros.experiments.inverse_truths import CONE_DEG, PLANNED, InverseTruth, TruthSpec
from brainshift_ros.experiments.skull_cases import SKULLS, build_memory_atlas
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.units import mm_to_m


@pytest.fixture(scope="module")
def atlas():
    mesh = head(6)
    model = patient(replace(mesh, nodes=mesh.nodes + mm_to_m([-35.0, 45.0, 50.0]) + 0.06 * np.array(PLANNED)))
    system = assemble_system(model.mesh, material_of(model.tissue))
    skull = SKULLS["contact, high cap"]
    return build_memory_atlas({False: system}, PLANNED, np.radians(CONE_DEG), 20, (0.35, 0.5, 0.65), skull)[0]


@pytest.fixture(scope="module")
def rows(atlas):
    """Estimates of a mixture of the atlas's own columns, 8 mm at the surface."""
    field = (atlas.columns([1, 20]) @ np.array([0.6, 0.4])).astype(float)
    truth = InverseTruth(TruthSpec(5, PLANNED, 0.5), atlas.mesh, field, np.ones(len(field), dtype=bool))
    by_group, by_distance = Comparison(atlas).rows(truth)
    labels = {"kind": CONTACT, "resected": False, "mannitol": False}
    return [labels | row for row in by_group], [labels | row for row in by_distance]


def of(rows, method, group, noise_mm=0.5):
    return next(r for r in rows if (r["method"], r["group"], r["noise_mm"]) == (method, group, noise_mm))


def test_a_mixture_of_columns_is_found_by_constraints_and_by_its_whole_field(rows):
    for group in ("surface", "deep"):
        assert of(rows[0], CONSTRAINED, group)["correction_percent"] > 90.0
        assert of(rows[0], BEST_CONSTRAINED, group, 0.0)["correction_percent"] > 99.9
        assert of(rows[0], NOTHING, group)["correction_percent"] == pytest.approx(0.0, abs=1e-9)


def test_least_squares_fits_the_noise_and_shows_it_far_away(rows):
    unconstrained, constrained = (of(rows[0], method, "deep") for method in (LEAST_SQUARES, CONSTRAINED))
    assert unconstrained["residual_mm"] < constrained["residual_mm"]
    assert unconstrained["error_mm"] > 2.0 * constrained["error_mm"]
    assert unconstrained["negative"] > 0 == constrained["negative"]


def test_the_limit_on_the_sum_is_what_keeps_a_large_shift_from_being_followed(atlas):
    field = 2.0 * atlas.columns([0])[:, :, 0].astype(float)
    truth = InverseTruth(TruthSpec(6, PLANNED, 0.35), atlas.mesh, field, np.ones(len(field), dtype=bool))
    rows, _ = Comparison(atlas).rows(truth)
    assert of(rows, NO_LIMIT, "surface")["correction_percent"] > 90.0
    assert of(rows, CONSTRAINED, "surface")["correction_percent"] < 75.0
    assert of(rows, CONSTRAINED, "surface")["sum_of_sizes"] == pytest.approx(1.0)


def test_all_methods_see_the_same_points(rows):
    for noise_mm in (0.5, 1.0):
        assert len({row["points"] for row in rows[0] if row["noise_mm"] == noise_mm}) == 1
    assert {row["method"] for row in rows[0]} > {NOTHING, MEAN, SHIPPED, *METHODS}
    assert set(METHODS) < set(charts.COLORS)


def test_errors_by_distance_are_those_of_the_groups(rows):
    """A distance bin holds each target once, so its parts cannot be further apart than the groups' extremes."""
    binned = [row for row in rows[1] if row["method"] == NOTHING]
    assert sum(row["targets"] for row in binned) > 0
    for row in binned:
        assert row["error_mm"] == pytest.approx(row["shift_mm"])


GROUPS = ("surface", "subsurface", "deep", "contralateral")


def made_up(corrections, residual_mm, truths=30):
    """Estimates of several truths: the correction of each method near and far, with a little scatter."""
    rng = np.random.default_rng(0)
    rows = []
    for truth in range(truths):
        scatter = rng.normal(0.0, 1.0)
        for method in (MEAN, *METHODS, SHIPPED):
            near, far = corrections.get(method, (50.0, 40.0))
            for group in GROUPS:
                value = (near if group.endswith("surface") else far) + scatter + rng.normal(0.0, 0.5)
                told = {"residual_mm": residual_mm.get(method, 1.0), "nonzero": 3, "negative": 0, "sum_of_sizes": 1.0}
                error = {"group": group, "shift_mm": 10.0, "error_mm": 10.0 - value / 10.0, "correction_percent": value}
                labels = {"kind": CONTACT, "truth": truth, "resected": False, "mannitol": truth % 2 == 0, "noise_mm": 0.5}
                rows.append(labels | {"points": 20, "method": method, "cpu_s": 0.1} | error | told)
                if method == MEAN:
                    rows.append(rows[-1] | {"method": BEST_CONSTRAINED, "noise_mm": 0.0, "points": 0})
                rows.append(rows[-1] | {"points": 20, "noise_mm": 1.0, "method": method})
    return rows


def test_the_verdict_tells_the_methods_apart():
    gcv, small, large = "Tikhonov, GCV", "Tikhonov, λ = 1e-08", "Tikhonov, λ = 1e-02"
    corrections = {CONSTRAINED: (95.0, 85.0), LEAST_SQUARES: (94.0, -300.0), gcv: (95.0, 84.0), small: (95.0, 60.0)}
    fit = {CONSTRAINED: 0.8, LEAST_SQUARES: 0.0, gcv: 0.6, small: 0.2, large: 2.0}
    line = thesis_line(made_up(corrections, fit))
    reproduced, refuted = line.index("reproduced for"), line.index("refuted for")
    assert reproduced < line.index(LEAST_SQUARES) < refuted
    assert reproduced < line.index(small) < refuted < line.index(gcv)
    assert line.index(large) > line.index("not applicable")
    few = thesis_line(made_up(corrections, fit, truths=3))
    assert "reproduced" not in few
    assert few.index("undecided for") < few.index(LEAST_SQUARES)


def test_what_is_asked_is_met_or_missed():
    line = asked_line(made_up({SHIPPED: (80.0, 50.0), MEAN: (92.0, 0.0)}, {}))
    assert "surface, 0.5 mm noise: 80." in line
    assert line.count("missed: 85 %") == 2
    assert line.count("met: 75 %") == 2
    assert "the whole field known: 9" in line


def test_the_tests_pair_truths():
    """The scatter that all methods share is larger than what sets them apart: unpaired, nothing would be seen."""
    rows = made_up({CONSTRAINED: (80.0, 80.0), "Tikhonov, GCV": (79.5, 80.0)}, {})
    tested = signed_rank_tests(rows)["Tikhonov, GCV"]
    assert tested["surface"]["p"] < 0.01
    assert tested["surface"]["median"] == pytest.approx(0.5, abs=0.4)
    assert tested["deep"]["p"] > 0.05


def test_tables_hold_what_was_measured():
    table = made_up({CONSTRAINED: (90.0, 70.0)}, {}, truths=8)
    assert by_method(table, np.mean, 0.5)[CONSTRAINED]["surface"] == pytest.approx(90.0, abs=1.0)
    written = [r for r in comparison_table(table) if (r["method"], r["group"], r["noise_mm"]) == (CONSTRAINED, "deep", 1.0)]
    assert written[0]["truths"] == 8
    assert written[0]["correction_percent_mean"] == pytest.approx(70.0, abs=1.0)
    assert summary_of([*table, *(row | {"kind": "other", "truth": row["truth"] + 100} for row in table)])["truths"] == {
        CONTACT: 8,
        "other": 8,
    }


@pytest.mark.slow
def test_pictures_have_a_panel_for_each_group(rows):
    assert len(charts.by_group(rows[0]).axes) == 6
    assert len(charts.by_kind(rows[0]).axes) == 3
    assert len(charts.over_lambda(rows[0]).axes) == 3
    assert len(charts.over_distance(rows[1]).axes) == 2


@pytest.mark.parametrize("full", [False, True])
def test_kinds_hold_different_truths_enough_of_them(full):
    made = kinds(full)
    seeds = [spec.seed for kind in made for spec in kind.specs]
    assert len(set(seeds)) == len(seeds)
    assert made[0].name == CONTACT
    assert len(made[0].specs) == (60 if full else 12)
    outside = next(kind for kind in made if kind.name == "outside the cone")
    angles = [np.degrees(np.arccos(np.dot(spec.direction, PLANNED) / np.linalg.norm(PLANNED))) for spec in outside.specs]
    assert min(angles) > CONE_DEG + 4.9
    assert all(spec.resected for kind in made if kind.collapse_mm for spec in kind.specs)
    assert all(spec.mannitol == 0.0 for kind in made for spec in kind.specs if spec.finite_strain)

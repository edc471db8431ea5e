"""The studies' own parts: the manufactured solution, its rates, the comparison of meshes, what charts are made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mechanics_cases import head, patient

from brainshift_ros.experiments.elements import ENTRIES, _means, _verdict, chart
from brainshift_ros.experiments.elements_box import SIDE_M, body_force, box_row, exact
from brainshift_ros.experiments.elements_brain import COMPARED, compared, directions_of, solve_brain
from brainshift_ros.units import mm_to_m

INSIDE = np.random.default_rng(0).uniform(0.0, SIDE_M, (3, 5))


def test_the_manufactured_field_has_no_divergence_and_its_force_balances_it():
    h = 1e-5
    steps = h * np.eye(3)
    slope = [(exact(INSIDE + s[:, None]) - exact(INSIDE - s[:, None])) / (2 * h) for s in steps]
    divergence = sum(slope[i][i] for i in range(3))
    assert np.abs(divergence).max() < 1e-6 * np.abs(slope).max()
    laplacian = sum(exact(INSIDE + s[:, None]) - 2.0 * exact(INSIDE) + exact(INSIDE - s[:, None]) for s in steps) / h**2
    assert body_force(INSIDE, 700.0) == pytest.approx(-700.0 * laplacian, rel=1e-4, abs=1e-4 * np.abs(700.0 * laplacian).max())


@pytest.mark.parametrize(("element", "cells", "order"), [("P1", (6, 12), 2.0), ("P2", (3, 6), 3.0)])
def test_errors_fall_with_the_elements_order(element, cells, order):
    coarse, fine = (box_row(count, element, 0.3) for count in cells)
    assert np.log2(coarse["error"] / fine["error"]) == pytest.approx(order, abs=0.45)
    assert fine["dofs"] > 6 * coarse["dofs"]


def test_directions_start_with_the_planned_one_and_the_rim():
    directions = np.array(directions_of(5))
    planned = np.array([0.0, -0.94, -0.34]) / np.hypot(0.94, 0.34)
    angles = np.degrees(np.arccos(np.clip(directions @ planned, -1.0, 1.0)))
    assert angles[:COMPARED] == pytest.approx([0.0, 20.0], abs=1e-5)
    assert len(np.unique(directions.round(9), axis=0)) == 5


@pytest.fixture(scope="module")
def small_head():
    mesh = head(6)
    # The study's craniotomy lies on a brain: the ball is moved under it.
    center = mm_to_m([-35.0, 45.0, 50.0])
    return patient(replace(mesh, nodes=mesh.nodes + center + 0.06 * np.array([0.0, -0.94, -0.34])))


def test_a_solution_differs_from_itself_by_nothing_and_from_another_element_by_something(small_head):
    directions = directions_of(3)
    linear, quadratic = (solve_brain(small_head, element, directions) for element in ("P1", "P2"))
    same = compared(quadratic, replace(quadratic, fields={k: v.copy() for k, v in quadratic.fields.items()}))
    assert max(row["error_mm_mean"] for row in same) < 1e-9
    rows = compared(linear, quadratic)
    assert {row["mechanism"] for row in rows} == {"gravity", "mannitol"}
    assert min(row["error_mm_mean"] for row in rows if row["group"] == "deep") > 1e-3
    means = _means(rows + compared(quadratic, quadratic))
    assert means[0]["atlas_s"] == pytest.approx(means[0]["factorise_s"] + ENTRIES * means[0]["entry_s"])
    assert "the most accurate within 60 s is P2 on" in _verdict(means)
    assert len(chart([box_row(2, "P1", 0.45), box_row(2, "P2", 0.499)], means).axes) == 4


def test_the_verdict_prefers_what_is_as_accurate_for_less():
    def mean(element, vertices, error, seconds):
        row = {"element": element, "vertices": vertices, "mechanism": "gravity"}
        return row | {"error_mm_mean": error, "atlas_s": seconds}

    default = mean("P1", 19_000, 0.3, 100.0)
    assert _verdict([default, mean("P1", 5_000, 0.6, 20.0), mean("P2", 2_000, 0.29, 50.0)]).startswith("P2 on 2,000")
    verdict = _verdict([default, mean("P2", 2_000, 0.31, 50.0), mean("P2", 5_000, 0.1, 150.0)])
    assert verdict.startswith("nothing measured is as accurate as P1 on 19,000")
    assert "within 60 s is P2 on 2,000" in verdict

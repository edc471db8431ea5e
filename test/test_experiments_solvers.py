"""The study of solvers: what it measures of one problem, and what it concludes from a table."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.experiments import solvers
from brainshift_ros.experiments.solvers_cases import HARD, SolverCase
from brainshift_ros.inverse.methods import METHODS
from brainshift_ros.inverse.problem import WeightProblem


def row(method, cpu_s, kkt, *, truth=0, rows=72, family="24 points, 720 columns"):
    return {
        **{"family": family, "case": "720 columns", "truth": truth, "rows": rows, "columns": 720, "method": method},
        **{"cpu_s": cpu_s, "kkt_residual": kkt, "converged": kkt < 1e-3, "nonzero": 5},
    }


TABLE = [
    *(row("constrained", cpu, 1e-16, truth=t) for t, cpu in enumerate((0.004, 0.006, 0.020))),
    *(row("nnls", cpu, 1e-9, truth=t) for t, cpu in enumerate((0.008, 0.006, 0.060))),
    row("osqp", 0.4, 1e-2),
    row("clarabel", 0.2, 1e-11),
    row("constrained", 0.1, 1e-15, rows=5001, family="5,001 rows, 720 columns"),
    row("tikhonov", 0.9, 1e-15, rows=5001, family="5,001 rows, 720 columns"),
]


def test_the_summary_counts():
    families = solvers.summarise(TABLE)["families"]
    assert list(families) == ["24 points, 720 columns", "5,001 rows, 720 columns"]
    own = families["24 points, 720 columns"]["constrained"]
    assert own["problems"] == 3
    assert own["cpu_ms_median"] == pytest.approx(6.0)
    assert own["cpu_ms_max"] == pytest.approx(20.0)
    assert families["24 points, 720 columns"]["osqp"]["not_converged"] == 1
    assert "nnls" not in families["5,001 rows, 720 columns"]


def test_the_reason_for_the_default_is_computed():
    said = solvers.why(TABLE)
    assert "largest KKT residual over 4 problems 1e-15, within 1e-12" in said
    assert "nnls 2.0 times, osqp 100.0 times, clarabel 50.0 times" in said  # medians over the problems both solved
    assert "sparse: median 6.0 ms, 2 of 3 within 10 ms" in said
    assert "5,000 rows: median 100.0 ms, 1 of 1 within 300 ms" in said
    worse = [row("constrained", 0.004, 1e-9), *TABLE[1:]]
    assert "1e-09, beyond 1e-12" in solvers.why(worse)


def test_every_method_is_in_the_study():
    assert {*solvers.CONSTRAINED, *(name for name in METHODS if name not in solvers.CONSTRAINED)} == set(METHODS)
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 4))
    case = SolverCase("6 rows", "4 columns", 0, WeightProblem(A, A @ [0.5, 0.0, 0.2, 0.0], (WeightGroup("all", (0, 1, 2, 3)),)))
    measured = solvers._row(case, "constrained", METHODS["constrained"])
    assert (measured["rows"], measured["columns"], measured["nonzero"]) == (6, 4, 2)
    assert measured["largest_weight"] == pytest.approx(0.5)
    assert 0.0 < measured["cpu_s"] < 10.0


@pytest.mark.parametrize("name", HARD)
def test_hard_columns_are_what_they_are_called(name):
    rng = np.random.default_rng(0)
    A = rng.normal(size=(12, 20))
    changed = HARD[name](A, rng)
    assert np.isfinite(changed).all()
    assert np.linalg.matrix_rank(changed) == (3 if name in ("rank 3", "one point") else 12)
    assert (changed.shape == A.shape) == (name in ("rank 3", "sizes from 1e-6 to 1"))


def test_the_chart_has_a_panel_a_family():
    figure = solvers.chart(TABLE)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == ["24 points, 720 columns", "5,001 rows, 720 columns"]

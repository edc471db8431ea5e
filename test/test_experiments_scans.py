"""The study of scans: what its figures count, and that a false or missing result cannot look good."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from brainshift_ros.experiments import scan_limits
from brainshift_ros.experiments.results import write_results
from brainshift_ros.experiments.scan_scores import CaseScore, PointScore, RegistrationScore, row_of
from brainshift_ros.experiments.scans import REQUIRED, failures_of, figures, run, summarise
from brainshift_ros.experiments.scans_pictures import calibration_chart, point_chart, tre_chart
from brainshift_ros.registration.verdict import Evidence


def evidence():
    return Evidence(**dict.fromkeys(Evidence.__dataclass_fields__, 0.5))


def points(errors_mm, sigma_mm=0.5, seed=0):
    """Points with errors of these lengths in random directions; NaN is a false point."""
    direction = np.random.default_rng(seed).normal(size=(len(errors_mm), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    residual = direction * np.asarray(errors_mm, dtype=float)[:, None]
    return PointScore(residual, np.full(len(errors_mm), sigma_mm), covered=0.9, wall_s=0.5, cpu_s=0.4)


def score(number=0, tre_mm=0.4, accepted=True, found=None, tags=("frontal", "left", "shift 3-6 mm")):
    result = SimpleNamespace(accepted=accepted, reasons=() if accepted else ("the gyri do not match",), evidence=evidence())
    registration = RegistrationScore(result, np.full(200, tre_mm), np.full(12, 1.1 * tre_mm), wall_s=0.4, cpu_s=0.3)
    times = {"icp": 0.2, "verdict": 0.1}
    refusal = "; ".join(result.reasons)
    return CaseScore(f"case_{number:02d}", frozenset(tags), 5.0, 9.0, 6.0, registration, found, refusal, None, times)


def test_errors_pool_over_points_and_targets():
    found = figures([score(0, 0.4, found=points([0.5] * 30)), score(1, 0.8, found=points([1.0] * 10))])
    assert found["tre_surface_median_mm"] in (0.4, 0.8)
    assert found["tre_accepted_max_mm"] == pytest.approx(0.88)
    assert found["point_error_median_mm"] == pytest.approx(0.5)
    assert found["point_error_p95_mm"] == pytest.approx(1.0)
    assert found["points_fewest"] == 10
    assert found["cases_below_20_points"] == 1


def test_a_refused_registration_counts_as_refused_and_not_as_accurate_or_wrong():
    scores = [score(0, 0.4, found=points([0.5] * 30)), score(1, 9.0, accepted=False)]
    summary = summarise(scores)
    assert summary["sets"]["tuned"]["accepted"] == 1
    assert summary["sets"]["tuned"]["cases"] == 2
    assert summary["sets"]["tuned"]["tre_accepted_max_mm"] < 1.0
    assert summary["failures"]["case_01"] == ["registration refused (TRE up to 9.9 mm): the gyri do not match"]


def test_a_wrong_registration_that_was_accepted_fails_its_set():
    summary = summarise(
        [score(number, 0.4, found=points([0.5] * 30)) for number in range(9)] + [score(9, 3.1, found=points([0.5] * 30))]
    )
    assert summary["met"]["tuned"]["tre_surface_median_mm"]
    assert not summary["met"]["tuned"]["tre_accepted_max_mm"]
    assert "accepted with a TRE of 3.4 mm" in summary["failures"]["case_09"][0]


def test_false_points_are_infinitely_wrong():
    found = points([0.3] * 15 + [np.nan] * 5)
    assert np.isinf(found.error_mm).sum() == 5
    assert figures([score(found=found)])["point_error_p95_mm"] is None
    assert figures([score(found=found)])["false_points"] == 5
    summary = summarise([score(found=found)])
    assert not summary["met"]["tuned"]["point_error_p95_mm"]
    assert any("95 %" in said for said in failures_of(score(found=found)))
    few = points([0.3] * 99 + [np.nan])
    assert figures([score(found=few)])["point_error_p95_mm"] == pytest.approx(0.3)


def test_an_accepted_case_without_points_has_none():
    lost = score(0, found=None)
    assert figures([lost, score(1, found=points([0.5] * 30))])["points_fewest"] == 0
    assert failures_of(lost)[0].startswith("no points")


def test_normal_errors_are_calibrated_and_halved_sigmas_are_not():
    residual = np.random.default_rng(0).normal(scale=0.5, size=(4000, 3))
    for claimed, within in ((0.5, 0.683), (0.25, 0.383)):
        found = PointScore(residual, np.full(4000, claimed), 1.0, 0.0, 0.0)
        assert figures([score(found=found)])["within_sigma"] == pytest.approx(within, abs=0.01)
    assert not summarise([score(found=found)])["met"]["tuned"]["within_sigma"]


def test_held_out_cases_are_a_set_of_their_own():
    summary = summarise([score(3, 0.4, found=points([0.5] * 30)), score(40, 2.0, found=points([0.5] * 30))])
    assert summary["sets"]["held out"]["tre_surface_median_mm"] == pytest.approx(2.0)
    assert summary["met"]["tuned"]["tre_surface_median_mm"]
    assert not summary["met"]["held out"]["tre_surface_median_mm"]
    assert set(summary["met"]["tuned"]) == set(REQUIRED)


def test_files_can_be_written_whatever_came_out(tmp_path):
    scores = [score(0, found=points([0.3, np.nan])), score(1, accepted=False), score(36, found=points([]))]
    write_results(tmp_path, summarise(scores), [row_of(found) for found in scores])
    json.loads((tmp_path / "summary.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 4
    for chart in (tre_chart, point_chart, calibration_chart):
        assert chart(scores).axes


@pytest.mark.slow
def test_the_few_cases_meet_what_is_required(tmp_path):
    summary = run(tmp_path, full=False, progress=lambda stage, share: None)
    assert all(summary["met"]["tuned"].values()), summary["failures"]


def trial(level, **keywords):
    return scan_limits.Trial("shift", level, score(int(level), **keywords))


def test_a_limit_lies_below_the_first_level_at_which_any_case_fails():
    good = points([0.5] * 30)
    trials = [trial(10, found=good), trial(20, found=good), trial(20, found=points([0.5] * 9)), trial(30, found=good)]
    summary = scan_limits.summarise(trials)
    assert summary["axes"]["shift"]["all_required_up_to"] == 10
    assert list(summary["axes"]["shift"]["failures"].values()) == [["9 points"]]
    assert summary["silently_wrong"] == 0
    assert scan_limits.chart(trials).axes


def test_only_what_was_handed_on_can_be_silently_wrong():
    assert trial(10, tre_mm=3.1, found=points([0.5] * 30)).silent
    assert trial(10, found=points([0.5] * 20 + [2.5] * 10)).silent
    assert not trial(10, tre_mm=9.0, accepted=False).silent
    assert not trial(10, found=points([])).silent
    assert not trial(10, found=points([0.5] * 30)).silent

"""The studies of consolidation and of mannitol's size, small."""

from __future__ import annotations

import json

import numpy as np
import pytest
from mechanics_cases import head, patient

from brainshift_ros.experiments import consolidation, mannitol


@pytest.mark.slow
def test_study_of_consolidation_finds_small_errors_and_no_oscillation(tmp_path):
    seen = []
    summary = consolidation.run(tmp_path, False, lambda stage, fraction: seen.append(fraction))
    for name in ("summary.json", "table.csv", "overshoot.csv", "terms.csv", "consolidation.png", "stabilization.png"):
        assert (tmp_path / name).stat().st_size > 0
    assert 0.0 <= min(seen) <= max(seen) <= 1.0
    finest = max(row["cells"] for row in summary["errors"] if row["problem"] == "Terzaghi")
    best = [row for row in summary["errors"] if (row["problem"], row["cells"]) == ("Terzaghi", finest)]
    assert min(row["RMS error of p / load"] for row in best) < 1.5e-3
    assert max(row["residual"] for row in summary["errors"]) < 1e-10
    assert max(row["overshoot, %"] for row in summary["overshoot"] if row["stabilised"]) < 1.0
    assert max(row["overshoot, %"] for row in summary["overshoot"] if not row["stabilised"]) > 100.0
    for curve in summary["cryer"].values():
        assert np.abs(np.subtract(curve["computed"], curve["series"]))[5:].max() < 0.06


def test_study_of_mannitol_follows_fields_to_the_steady_one(tmp_path, monkeypatch):
    monkeypatch.setattr(mannitol, "FINE_S", 600.0)
    monkeypatch.setattr(mannitol, "COARSE_S", 7200.0)
    monkeypatch.setattr(mannitol, "DT_S", (2400.0, 1200.0))
    summary = mannitol.study(patient(head(4)), tmp_path, ("free_cap",), lambda stage, fraction: None)
    assert json.loads((tmp_path / "summary.json").read_text())["rows"] == json.loads(json.dumps(summary["rows"]))
    assert (tmp_path / "mannitol.png").stat().st_size > 0
    for case in mannitol.CASES:
        own = [row for row in summary["rows"] if (row["skull"], row["case"]) == ("free_cap", case)]
        timed = [row for row in own if row["minutes"] != "steady"]
        assert [row["minutes"] for row in timed] == pytest.approx([10.0, 20.0, 40.0, 60.0, 120.0, 360.0, 1440.0])
        # The later the more alike; the coarse steps after two hours may lag a little.
        assert np.all(np.diff([row["left_percent"] for row in timed[:5]]) < 0.0)
        assert timed[-1]["left_percent"] < 1.0
        assert all(0.0 <= row["scale"] <= 1.0 for row in timed)
        steps = summary["skulls"]["free_cap"]["longer time steps at 40 minutes"]
        assert steps["1200 s"][f"{case}: difference, %"] < steps["2400 s"][f"{case}: difference, %"]

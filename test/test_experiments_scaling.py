"""The study of an atlas's cost over mesh size, on balls instead of brains."""

from __future__ import annotations

import json
from dataclasses import replace

from mechanics_cases import head, patient

from brainshift_ros.experiments import scaling
from brainshift_ros.experiments.patients import patient_path
from brainshift_ros.mesh.patient_file import patient_digest, write_patient


def test_each_size_is_built_and_measured_in_its_own_process(tmp_path, monkeypatch):
    models = {100: patient(head(4)), 300: patient(head(6))}
    for nodes, model in models.items():
        known = replace(model, patient_id=patient_digest(model.mesh, model.tissue, model.cortex, model.image))
        write_patient(patient_path(tmp_path, nodes, 0), known)
    monkeypatch.setattr(scaling, "SIZES", tuple(models))
    monkeypatch.setattr(scaling, "SCENE", "config/scene_demo.yaml")
    scaling.run(tmp_path, False, lambda stage, fraction: None)
    rows = json.loads((tmp_path / "summary.json").read_text())["rows"]
    assert [row["nodes"] for row in rows] == [len(model.mesh.nodes) for model in models.values()]
    assert all(row["entries"] == 60 and row["residual"] < 1e-9 and row["peak memory, MB"] > 50.0 for row in rows)
    assert (tmp_path / "table.csv").exists()
    assert (tmp_path / "scaling.png").stat().st_size > 10_000

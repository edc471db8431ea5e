"""The inverse methods on the demo's atlas: time, optimality and error of each against a truth outside the atlas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bench.measure import timed
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.inverse.methods import METHODS, solve_weights
from brainshift_ros.inverse.problem import WeightProblem
from brainshift_ros.mechanics.forward import solve_gravity
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.simulation.targets import target_groups
from brainshift_ros.simulation.truth import direction_between
from brainshift_ros.units import mm_to_m

POINTS, NOISE_M, CASES = 20, 0.5e-3, 5


def run(atlas_path: Path, patient: PatientModel) -> list[dict[str, Any]]:
    """Measure 20 noisy surface points of a solution whose orientation is in no column, and fit them by every method."""
    with open_atlas(atlas_path) as atlas:
        scene, entries, groups = atlas.scene, atlas.entries, atlas.groups
        E = atlas.columns(np.arange(len(entries))).astype(np.float64)
    assert scene.gravity is not None
    assert scene.craniotomy is not None
    direction = direction_between(
        [e.gravity_direction for e in entries], scene.gravity.direction, np.radians(scene.gravity.cone_deg)
    )
    truth = solve_gravity(patient.mesh, material_of(patient.tissue), direction, entries[0].fluid_level).displacement
    targets = target_groups(patient.mesh, mm_to_m(scene.craniotomy.center_mm), scene.craniotomy.diameter_mm / 2000.0)
    rows: list[dict[str, Any]] = []
    for method in METHODS:
        errors: dict[str, list[float]] = {name: [] for name in targets}
        for case in range(CASES):
            rng = np.random.default_rng(case)
            nodes = rng.choice(targets["surface"], POINTS, replace=False)
            measured = truth[nodes] + rng.normal(0.0, NOISE_M, (POINTS, 3))
            problem = WeightProblem(E[nodes].reshape(3 * POINTS, -1) / NOISE_M, measured.ravel() / NOISE_M, groups)
            solved = timed(lambda problem=problem, method=method: solve_weights(problem, method))
            estimated = E @ solved.result.weights
            for name, ids in targets.items():
                error = np.linalg.norm(estimated[ids] - truth[ids], axis=1).mean()
                errors[name].append(100.0 * (1.0 - error / np.linalg.norm(truth[ids], axis=1).mean()))
        rows.append(
            {
                "method": method,
                "wall, ms": 1e3 * solved.wall_s,
                "CPU, ms": 1e3 * solved.cpu_s,
                "kkt_residual": solved.result.kkt_residual,
                **{f"{name}, % corrected": float(np.mean(values)) for name, values in errors.items()},
            }
        )
    return rows

"""The inverse methods on the demo's atlas, and from points to weights on an atlas of full size."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.measure import timed
from brainshift_ros.atlas.file import AtlasFile, open_atlas
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.methods import METHODS, solve_weights
from brainshift_ros.inverse.problem import WeightProblem
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.inverse.weighting import weighted_problem
from brainshift_ros.mechanics.forward import solve_gravity
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.simulation.targets import target_groups
from brainshift_ros.simulation.truth import direction_between
from brainshift_ros.units import mm_to_m

POINTS, NOISE_M, CASES = 20, 0.5e-3, 5

#: Measured points: the most of the thesis's patients, 5,000 dense rows, and 5,000 dense points.
COUNTS = (24, 1_667, 5_000)


def run(atlas_path: Path, patient: PatientModel) -> list[dict[str, Any]]:
    """Measure 20 noisy surface points of a solution whose orientation is in no column, and fit them by every method."""
    with open_atlas(atlas_path) as atlas:
        scene, entries, groups = atlas.scene, atlas.entries, AppendedAtlas(atlas, None).groups
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


def points_to_weights(atlas_path: Path) -> list[dict[str, Any]]:
    """Read the rows at few and many points from the file, and solve: times, and memory beside that of the whole matrix."""
    rows: list[dict[str, Any]] = []
    with open_atlas(atlas_path) as atlas:
        locator, whole = PointLocator(atlas.mesh), AppendedAtlas(atlas, None)
        for count in COUNTS:
            measured = _measured(atlas, count)
            rows_at_points(whole, measured, locator=locator)  # the locator finds its surface on first use
            tracemalloc.start()
            found = rows_at_points(whole, measured, locator=locator)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            read = timed(lambda measured=measured: rows_at_points(whole, measured, locator=locator))
            kept = found.kept
            problem = weighted_problem(found.M, measured.displacements[kept], measured.sigma[kept], whole.groups)
            solved = timed(lambda problem=problem: solve_weights(problem))
            rows.append(
                {
                    "points": str(count),
                    "columns": problem.A.shape[1],
                    "nodes read": int(np.unique(atlas.mesh.elements[found.located.element]).size),
                    "read rows, wall ms": 1e3 * read.wall_s,
                    "read rows, CPU ms": 1e3 * read.cpu_s,
                    "peak memory of it, MB": peak / 1e6,
                    "whole matrix, MB": 4e-6 * 3 * len(atlas.mesh.nodes) * len(atlas.entries),
                    "solve, wall ms": 1e3 * solved.wall_s,
                    "solve, CPU ms": 1e3 * solved.cpu_s,
                    "kkt_residual": solved.result.kkt_residual,
                    "non-zero weights": int(np.count_nonzero(solved.result.weights)),
                }
            )
    return rows


def _measured(atlas: AtlasFile, count: int) -> HomologousPoints:
    """Points between the nodes of the cortex under the craniotomy, and a blend of three columns with noise there."""
    assert atlas.scene.craniotomy is not None
    rng = np.random.default_rng(count)
    skull: NDArray[np.int32] = atlas.mesh.facets["skull"]
    centers = atlas.mesh.nodes[skull].mean(axis=1)
    distance = np.linalg.norm(centers - mm_to_m(atlas.scene.craniotomy.center_mm), axis=1)
    opening = skull[distance <= atlas.scene.craniotomy.diameter_mm / 2000.0]
    chosen, shares = opening[rng.choice(len(opening), count)], rng.dirichlet(np.ones(3), count)
    columns = np.sort(rng.choice(len(atlas.entries), 3, replace=False))
    shift = atlas.columns(columns) @ np.array([0.4, 0.3, 0.2])
    points, moved = (np.einsum("na,nai->ni", shares, values[chosen]) for values in (atlas.mesh.nodes, shift))
    return HomologousPoints(points, moved + rng.normal(0.0, NOISE_M, moved.shape), np.full(count, NOISE_M))

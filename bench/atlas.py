"""Building the atlas: one factorisation for all entries against one factorisation an entry, and MKL against SciPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bench.measure import timed
from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.mechanics.forward import solve_system
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.patient import PatientModel

#: Entries that are also solved one by one; their time is scaled to the whole atlas.
SAMPLED = 4


def run(scene: Scene, patient: PatientModel, folder: Path, solvers: tuple[str, ...]) -> list[dict[str, Any]]:
    """Build the demo's atlas by each solver and compare sampled entries with their own factorisation."""
    rows: list[dict[str, Any]] = []
    for solver in solvers:
        path = folder / f"atlas_{solver}.h5"
        built = timed(lambda solver=solver, path=path: build_atlas(patient, scene, path, solver=solver), runs=1, warmup=0)
        with open_atlas(path) as atlas:
            chosen = np.linspace(0, len(atlas.entries) - 1, SAMPLED).astype(int)
            entries, columns = [atlas.entries[i] for i in chosen], atlas.columns(chosen)
        difference, seconds = 0.0, 0.0
        for number, entry in enumerate(entries):
            system = assemble_system(
                patient.mesh, material_of(patient.tissue), resected=entry.resected, septa=scene.septa, solver=solver
            )
            alone = timed(
                lambda system=system, entry=entry, solver=solver: solve_system(
                    system, entry.gravity_direction, entry.fluid_level, solver=solver
                ),
                runs=1,
                warmup=0,
            )
            seconds += alone.wall_s
            reference = alone.result.displacement
            difference = max(difference, float(np.abs(columns[:, :, number] - reference).max() / np.abs(reference).max()))
        one_by_one = seconds / SAMPLED * built.result.entries
        rows.append(
            {
                "solver": built.result.solver,
                "entries": built.result.entries,
                "wall, s": built.wall_s,
                "CPU, s": built.cpu_s,
                "one factorisation an entry, s": one_by_one,
                "ratio of wall times": one_by_one / built.wall_s,
                "largest relative difference": difference,
                "residual": built.result.residual,
            }
        )
    return rows

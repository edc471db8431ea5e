"""Building the whole atlas: one factorisation an element set, against one for each boundary-condition set, and NGSolve's.

All in one run, so that the machine's load is the same for all: time, CPU, memory and difference.
"""

from __future__ import annotations

import resource
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.measure import timed
from bench.peers.client import solve_matrix
from brainshift_ros.atlas.columns import entries_of
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.problem import case_of, under_craniotomy
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.experiments import scaling_case
from brainshift_ros.experiments.own_process import measured
from brainshift_ros.mechanics.cases import Case
from brainshift_ros.mechanics.forward import solve_case
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.skull import SkullName
from brainshift_ros.mechanics.steady import SteadyModel
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.solvers.direct import SolverName, factorize

#: Directions whose entries are also solved by factorisations of their own, in each resection state.
SAMPLED_DIRECTIONS = 10

#: Points whose rows are read from the file, and columns.
ROWS, COLUMNS = 300, 10


def build(what: str, patient_path: Path, scene_path: Path, output: Path) -> dict[str, Any]:
    """Build an atlas in a process of its own, so that time and peak memory are its own."""
    paths = (path.absolute() for path in (patient_path, scene_path, output))
    return {"what": what, **measured(scaling_case.__name__, list(paths))}


def read(path: Path) -> list[dict[str, Any]]:
    """Time opening an atlas, reading the rows of some hundred points, and reading whole columns."""
    rng = np.random.default_rng(0)

    def open_and_close() -> None:
        with open_atlas(path):
            pass

    rows = [{"what": "open, every checksum", "wall, ms": 1e3 * timed(open_and_close, runs=3).wall_s}]
    with open_atlas(path) as atlas:
        nodes = rng.choice(len(atlas.mesh.nodes), ROWS, replace=False)
        columns = rng.choice(len(atlas.entries), min(COLUMNS, len(atlas.entries)), replace=False)
        rows.append({"what": f"{ROWS} nodes, all columns", "wall, ms": 1e3 * timed(lambda: atlas.rows(nodes)).wall_s})
        by_column = timed(lambda: atlas.columns(columns))
        rows.append({"what": f"{len(columns)} columns, all nodes", "wall, ms": 1e3 * by_column.wall_s})
    return rows


def against_refactoring(
    patient: PatientModel, scene: Scene, skull: SkullName, solver: SolverName = "auto"
) -> list[dict[str, Any]]:
    """Solve sampled boundary-condition sets both ways: the atlas's, and a factorisation of their own for each.

    Every other direction is solved for gravity, the rest for mannitol where the scene has it, at another level each.
    """
    opening = under_craniotomy(patient.mesh, scene.craniotomy)
    material = material_of(patient.tissue)
    rows = []
    for resected in (False, True):
        cases = _sample([case_of(entry, scene) for entry in entries_of(scene) if entry.resected == resected])
        system = assemble_system(patient.mesh, material, resected=resected, septa=scene.septa, solver=solver)
        every = list(dict.fromkeys(entry.gravity_direction for entry in entries_of(scene)))
        model = SteadyModel(system, every, skull=skull, opening=opening, solver=solver)
        fast = _displacements(model, cases, len(patient.mesh.nodes))
        alone = [
            timed(
                lambda case=case, s=system: solve_case(s, case, skull=skull, opening=opening, solver=solver), runs=1, warmup=0
            )
            for case in cases
        ]
        differences = [
            np.abs(fast[:, :, number] - one.result.displacement).max() / np.abs(one.result.displacement).max()
            for number, one in enumerate(alone)
        ]
        rows.append(
            {
                "state": "tumour resected" if resected else "with tumour",
                "skull": skull,
                "sets": len(cases),
                "factorisations a set": float(np.mean([one.result.iterations for one in alone])),
                "wall a set, s": float(np.mean([one.wall_s for one in alone])),
                "CPU a set, s": float(np.mean([one.cpu_s for one in alone])),
                "largest relative difference": float(max(differences)),
                "peak memory of the process so far, MB": _peak_mb(),
                "solver": model.name,
            }
        )
    return rows


def against_ngsolve(patient: PatientModel, scene: Scene) -> list[dict[str, Any]]:
    """Factorise and solve the matrix of one boundary-condition set by our solver and by NGSolve's sparse Cholesky."""
    system = assemble_system(patient.mesh, material_of(patient.tissue), septa=scene.septa)
    case = case_of(entries_of(scene)[0], scene)
    free = np.flatnonzero(~system.constrained(case.gravity_direction))
    matrix = system.stiffness[free][:, free].tocsr()
    load = system.gravity(case.gravity_direction, case.fluid_level)[free, None]
    factorised = timed(lambda: factorize(matrix), runs=3, warmup=1)
    ours = timed(lambda: factorised.result.solve(load))
    peer = solve_matrix(matrix, load)
    difference = np.abs(peer.solution - ours.result).max() / np.abs(ours.result).max()
    return [
        {
            "solver": factorised.result.name,
            "dofs": len(free),
            "factorise: wall, s": factorised.wall_s,
            "factorise: CPU, s": factorised.cpu_s,
            "one right-hand side: wall, s": ours.wall_s,
            "peak memory of the process so far, MB": _peak_mb(),
            "relative difference": 0.0,
        },
        {
            "solver": f"NGSolve {peer.version}",
            "dofs": len(free),
            "factorise: wall, s": peer.times_s["factorise_wall_s"],
            "factorise: CPU, s": peer.times_s["factorise_cpu_s"],
            "one right-hand side: wall, s": peer.times_s["solve_wall_s"],
            "peak memory of the process so far, MB": peer.peak_bytes / 1e6,
            "relative difference": float(difference),
        },
    ]


def _peak_mb() -> float:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def _sample(cases: Sequence[Case]) -> list[Case]:
    """One case of each sampled direction, going through mechanisms and levels in turn."""
    directions = list(dict.fromkeys(case.gravity_direction for case in cases))
    chosen = np.linspace(0, len(directions) - 1, min(SAMPLED_DIRECTIONS, len(directions))).astype(int)
    sampled = []
    for number, index in enumerate(chosen):
        of_direction = [case for case in cases if case.gravity_direction == directions[index]]
        sampled.append(of_direction[number % len(of_direction)])
    return sampled


def _displacements(model: SteadyModel, cases: Sequence[Case], nodes: int) -> NDArray[np.float64]:
    columns = np.empty((nodes, 3, len(cases)))
    for block in model.solve(cases):
        columns[:, :, block.cases] = block.displacement
    return columns

"""What all jobs of a build share, and the model that solves the jobs of one resection state."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.diagnostics import DIAGNOSTICS, state_name
from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.atlas.jobs import Job, SolvedJob
from brainshift_ros.atlas.scene import Craniotomy, Scene, Transient
from brainshift_ros.mechanics.cases import SWELLING_MARGIN_MM, Case
from brainshift_ros.mechanics.deformation import JacobianOfElements
from brainshift_ros.mechanics.materials import TissueProperties, material_of
from brainshift_ros.mechanics.steady import SolvedBlock, SteadyModel
from brainshift_ros.mechanics.system import System, assemble_system
from brainshift_ros.mechanics.transient import TransientModel
from brainshift_ros.mesh.patient import Tissue
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.solvers.direct import SolverName
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]

#: Stages whose times a build reports. `check` looks at each solution: its deformation and its shift.
ASSEMBLE, FACTORISE, SOLVE, CHECK, WRITE = "assemble", "factorise", "solve", "check", "write"


@dataclass(frozen=True)
class Problem:
    """The patient, what acts, and how to solve it: all that a machine needs to solve any job.

    Attributes
    ----------
    mesh, tissue
        Of the patient.
    scene
        What acts, and the model's settings.
    materials
        Properties of each tissue.
    directions
        Directions of gravity of all entries. A model is made for all of them, so that it serves every job.
    solver
        Of the linear systems.
    """

    mesh: TetMesh
    tissue: NDArray[np.uint8]
    scene: Scene
    materials: Mapping[Tissue, TissueProperties]
    directions: tuple[tuple[float, float, float], ...]
    solver: SolverName


class StateModel:
    """All forward solutions of one resection state; made once, since assembly and factorisation are the larger part.

    Parameters
    ----------
    problem
        What the jobs share.
    resected
        Whether the tumour's elements are removed.
    progress
        Called with a stage and the fraction of the preparation that is done.
    """

    def __init__(self, problem: Problem, resected: bool, progress: Progress) -> None:
        name, model = state_name(resected), problem.scene.model
        self._times_s: dict[str, float] = {}
        progress(f"{ASSEMBLE}, {name}", 0.0)
        with timed(self._times_s, ASSEMBLE):
            system = assemble_system(
                problem.mesh,
                material_of(problem.tissue, problem.materials),
                resected=resected,
                septa=problem.scene.septa,
                element=model.element,
                solver=problem.solver,
            )
            self._jacobian = JacobianOfElements(problem.mesh, system.submesh.parent_element)
        progress(f"{FACTORISE}, {name}", 0.4)
        self._opening = under_craniotomy(problem.mesh, problem.scene.craniotomy)
        with timed(self._times_s, FACTORISE):
            self._model = _model(problem, system, self._opening)
        self._name, self._scene, self._nodes = name, problem.scene, len(problem.mesh.nodes)
        self._warnings = tuple(f"{name}: {warning}" for warning in system.warnings)

    def solve(self, job: Job, progress: Progress) -> SolvedJob:
        """Solve a job.

        Parameters
        ----------
        job
            Of this resection state.
        progress
            Called with a stage and the fraction of the job that is done.

        Raises
        ------
        ArithmeticError
            A residual is too large.
        """
        times_s, self._times_s = self._times_s, {}
        columns = np.empty((self._nodes, 3, len(job.entries)), dtype=np.float32)
        diagnostics = np.zeros(len(job.entries), dtype=DIAGNOSTICS)
        stage = f"{SOLVE}, {self._name}"
        progress(stage, 0.0)
        cases = [case_of(entry, self._scene) for entry in job.entries]
        blocks = self._model.solve(cases, lambda _, fraction: progress(stage, fraction))
        while True:
            with timed(times_s, SOLVE):
                block = next(blocks, None)
            if block is None:
                break
            with timed(times_s, CHECK):
                displacement = block.displacement.astype(np.float32)
                place = _place(block.cases)
                columns[:, :, place] = displacement
                diagnostics[place] = self._diagnosed(block, displacement)
        return SolvedJob(columns, diagnostics, self._model.name, self._model.variable_normals, self._warnings, times_s)

    def _diagnosed(self, block: SolvedBlock, displacement: NDArray[np.float32]) -> NDArray:
        rows = np.zeros(len(block.cases), dtype=DIAGNOSTICS)
        rows["residual"] = block.residual
        rows["contact_iterations"] = block.contact_iterations
        rows["closed_normals"] = block.closed_normals
        deformed = self._jacobian(displacement)
        rows["smallest_det_f"] = deformed.smallest
        rows["inverted_elements"] = deformed.inverted
        square = np.einsum("ncm,ncm->nm", displacement, displacement)
        rows["largest_shift"] = np.sqrt(square.max(axis=0))
        seen = self._opening
        rows["craniotomy_shift"] = np.nan if seen is None or not seen.any() else np.sqrt(square[seen].max(axis=0))
        return rows


def case_of(entry: AtlasEntry, scene: Scene) -> Case:
    """Forward problem that an entry stands for."""
    margin_mm = SWELLING_MARGIN_MM if scene.swelling is None else scene.swelling.margin_mm
    return Case(entry.mechanism, entry.gravity_direction, entry.fluid_level, entry.intensity, margin_mm)


def under_craniotomy(mesh: TetMesh, craniotomy: Craniotomy | None) -> NDArray[np.bool_] | None:
    """Outer nodes (N,) within the craniotomy's radius of its centre; None without a craniotomy."""
    if craniotomy is None:
        return None
    near = np.linalg.norm(mesh.nodes - mm_to_m(craniotomy.center_mm), axis=1) <= mm_to_m(craniotomy.diameter_mm / 2.0)
    outer = np.zeros(len(mesh.nodes), dtype=bool)
    outer[mesh.facets.get("skull", np.zeros((0, 3), np.int32))] = True
    return near & outer


@contextmanager
def timed(times_s: dict[str, float], stage: str) -> Iterator[None]:
    """Add the wall time of a block to its stage."""
    start = perf_counter()
    yield
    times_s[stage] = times_s.get(stage, 0.0) + perf_counter() - start


def _place(columns: list[int]) -> slice | list[int]:
    """Index of some columns: a slice where they are neighbours in order, since numpy scatters lists twenty times as slowly."""
    neighbours = range(columns[0], columns[0] + len(columns))
    return slice(neighbours.start, neighbours.stop) if columns == list(neighbours) else columns


def _model(problem: Problem, system: System, opening: NDArray[np.bool_] | None) -> SteadyModel | TransientModel:
    model = problem.scene.model
    if isinstance(model.time, Transient):
        return TransientModel(
            system,
            problem.directions,
            duration_s=model.time.duration_s,
            dt_s=model.time.dt_s,
            skull=model.skull,
            opening=opening,
            solver=problem.solver,
        )
    return SteadyModel(system, problem.directions, skull=model.skull, opening=opening, solver=problem.solver)

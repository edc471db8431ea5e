"""Build an atlas: all entries of a scene solved, written as one file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.columns import entries_of, groups_of
from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.atlas.file import AtlasContent, write_atlas
from brainshift_ros.atlas.scene import Craniotomy, Scene
from brainshift_ros.files import writable_target
from brainshift_ros.mechanics.many import ManySolver
from brainshift_ros.mechanics.materials import TABLE_1, Material, TissueProperties, material_of
from brainshift_ros.mechanics.solvers import SolverName
from brainshift_ros.mechanics.submesh import SHEETS
from brainshift_ros.mechanics.system import System, assemble_system
from brainshift_ros.mesh.patient import PatientModel, Tissue
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class BuildReport:
    """How a build went.

    Attributes
    ----------
    path, atlas_id
        The file and its id.
    entries
        Number of columns.
    solver
        Name of the linear solver that was used.
    residual
        Largest relative residual of all entries.
    variable_normals
        For each element set, the number of skull normals that some entries hold and others free.
    largest_shift
        Shape (m,), each entry's largest displacement, m.
    craniotomy_shift
        Shape (m,), each entry's largest displacement on the skull side under the craniotomy, m; None without one.
    times_s
        Wall time by stage.
    warnings
        What a person should know before trusting the atlas.
    """

    path: Path
    atlas_id: str
    entries: int
    solver: str
    residual: float
    variable_normals: tuple[int, ...]
    largest_shift: NDArray[np.float64]
    craniotomy_shift: NDArray[np.float64] | None
    times_s: Mapping[str, float]
    warnings: tuple[str, ...]


def build_atlas(
    patient: PatientModel,
    scene: Scene,
    output: str | Path,
    *,
    materials: Mapping[Tissue, TissueProperties] = TABLE_1,
    solver: SolverName = "auto",
    progress: Progress | None = None,
) -> BuildReport:
    """Solve all entries of a scene and write the atlas.

    Parameters
    ----------
    patient
        Mesh and tissue.
    scene
        What acts; decides the entries.
    output
        The atlas file; written whole or not at all.
    materials
        Properties of each tissue; the file keeps them.
    solver
        ``auto``, ``pardiso`` or ``scipy``.
    progress
        Called with a stage and the fraction of the build that is done.

    Raises
    ------
    InputError
        The scene asks for what is not modelled, or the patient's mesh cannot be solved.
    ArithmeticError
        A residual is too large.
    """
    report = progress if progress is not None else _silent
    entries = entries_of(scene)
    material = material_of(patient.tissue, materials)
    writable_target(output)
    E = np.empty((len(patient.mesh.nodes), 3, len(entries)), dtype=np.float32)
    times_s: dict[str, float] = {}
    resection_states = sorted({entry.resected for entry in entries})
    states = []
    for number, resected in enumerate(resection_states):

        def report_state(stage: str, fraction: float, number: int = number) -> None:
            report(stage, (number + fraction) / len(resection_states))

        states.append(_solve_state(patient, material, scene, entries, resected, E, solver, times_s, report_state))
    report("write", 1.0)
    content = AtlasContent(patient.patient_id, patient.mesh, patient.tissue, scene, entries, groups_of(entries), materials)
    with _timed(times_s, "write"):
        atlas_id = write_atlas(output, content, E)
    shift = np.sqrt(np.einsum("ncm,ncm->nm", E, E))  # no copy of E, which may fill much of the memory
    opening = None if scene.craniotomy is None else _under_craniotomy(patient.mesh, scene.craniotomy)
    return BuildReport(
        path=Path(output),
        atlas_id=atlas_id,
        entries=len(entries),
        solver=states[0].solver,
        residual=max(state.residual for state in states),
        variable_normals=tuple(state.variable_normals for state in states),
        largest_shift=shift.max(axis=0),
        craniotomy_shift=None if opening is None or not opening.any() else shift[opening].max(axis=0),
        times_s=times_s,
        warnings=_remarks(patient.mesh, scene, opening) + tuple(warning for state in states for warning in state.warnings),
    )


@dataclass(frozen=True)
class _StateReport:
    solver: str
    residual: float
    variable_normals: int
    warnings: tuple[str, ...]


def _solve_state(
    patient: PatientModel,
    material: Material,
    scene: Scene,
    entries: Sequence[AtlasEntry],
    resected: bool,
    E: NDArray[np.float32],
    solver: SolverName,
    times_s: dict[str, float],
    report: Progress,
) -> _StateReport:
    """Solve the entries of one resection state, which share their elements, into their columns of E."""
    name = "tumour resected" if resected else "with tumour"
    columns = [column for column, entry in enumerate(entries) if entry.resected == resected]
    cases = [entries[column] for column in columns]
    report(f"assemble, {name}", 0.0)
    with _timed(times_s, "assemble"):
        system = assemble_system(patient.mesh, material, resected=resected, septa=scene.septa, solver=solver)
    report(f"factorise, {name}", 0.2)
    with _timed(times_s, "factorise"):
        set_of_case, constraint_sets = _constraint_sets(system, cases)
        many = ManySolver(system.stiffness, constraint_sets, solver)

    def loads(numbers: Sequence[int]) -> NDArray[np.float64]:
        chosen = [cases[number] for number in numbers]
        return np.stack([system.gravity(case.gravity_direction, case.fluid_level) for case in chosen], axis=1)

    report(f"solve, {name}", 0.5)
    largest_residual, solved = 0.0, 0
    with _timed(times_s, "solve"):
        for numbers, solution, residual in many.solve(set_of_case, loads):
            E[:, :, [columns[number] for number in numbers]] = system.displacement(solution)
            largest_residual, solved = max(largest_residual, residual), solved + len(numbers)
            report(f"solve, {name}", 0.5 + 0.5 * solved / len(columns))
    warnings = tuple(f"{name}: {warning}" for warning in system.warnings)
    return _StateReport(many.name, largest_residual, many.variable_count, warnings)


def _constraint_sets(system: System, entries: Sequence[AtlasEntry]) -> tuple[list[int], NDArray[np.bool_]]:
    """Constraint set of each entry, and the distinct sets (s, 3n): fluid levels of one orientation share theirs."""
    directions = sorted({entry.gravity_direction for entry in entries})
    sets = np.array([system.constrained(direction) for direction in directions])
    return [directions.index(entry.gravity_direction) for entry in entries], sets


def _under_craniotomy(mesh: TetMesh, craniotomy: Craniotomy) -> NDArray[np.bool_]:
    """Outer nodes (N,) within the craniotomy's radius of its centre."""
    near = np.linalg.norm(mesh.nodes - mm_to_m(craniotomy.center_mm), axis=1) <= mm_to_m(craniotomy.diameter_mm / 2.0)
    outer = np.zeros(len(mesh.nodes), dtype=bool)
    outer[mesh.facets.get("skull", np.zeros((0, 3), np.int32))] = True
    return near & outer


def _remarks(mesh: TetMesh, scene: Scene, opening: NDArray[np.bool_] | None) -> tuple[str, ...]:
    """Say where the scene asks for what this patient's mesh does not have."""
    remarks = []
    if scene.septa and not any(len(mesh.facets.get(sheet, ())) for sheet in SHEETS):
        remarks.append("the scene asks for septa, but the patient's mesh has none: the brain was solved as one body")
    if scene.craniotomy is not None and opening is not None and not opening.any():
        remarks.append(f"no cortex lies under the craniotomy at {scene.craniotomy.center_mm} mm: check its centre")
    return tuple(remarks)


@contextmanager
def _timed(times_s: dict[str, float], stage: str) -> Iterator[None]:
    """Add the wall time of a block to its stage."""
    start = perf_counter()
    yield
    times_s[stage] = times_s.get(stage, 0.0) + perf_counter() - start


def _silent(stage: str, fraction: float) -> None:
    pass

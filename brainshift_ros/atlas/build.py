"""Build an atlas: all entries of a scene solved, written as one file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.building import building_folder, key_of
from brainshift_ros.atlas.columns import entries_of, groups_of
from brainshift_ros.atlas.diagnostics import limits_of_linear_theory
from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.atlas.file import AtlasContent, write_atlas
from brainshift_ros.atlas.here import solve_here
from brainshift_ros.atlas.jobs import Job, SolvedJob, jobs_of
from brainshift_ros.atlas.problem import WRITE, Problem, Progress, timed, under_craniotomy
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.errors import InputError
from brainshift_ros.files import writable_target
from brainshift_ros.mechanics.materials import TABLE_1, TissueProperties
from brainshift_ros.mechanics.submesh import SHEETS
from brainshift_ros.mesh.patient import PatientModel, Tissue
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.solvers.direct import SolverName

#: Share of a build that writing the file takes; for progress only.
_WRITING = 0.02


@dataclass(frozen=True)
class BuildReport:
    """How a build went.

    Attributes
    ----------
    path, atlas_id
        The file and its id.
    entries
        Number of columns.
    resumed
        Number of columns that an earlier, interrupted build had left.
    solver
        Name of the linear solver that was used.
    residual
        Largest relative residual of all entries.
    variable_normals
        For each element set, the number of skull normals that some entries hold and others free.
    diagnostics
        Shape (m,), how each entry's solution came about; see :mod:`brainshift_ros.atlas.diagnostics`.
    largest_shift
        Shape (m,), each entry's largest displacement, m.
    craniotomy_shift
        Shape (m,), each entry's largest displacement on the skull side under the craniotomy, m; None without one.
    times_s
        Wall time by stage, ``assemble``, ``factorise``, ``solve``, ``check``, ``write``: of this build, summed over the
        processes that took part.
    wall_s
        Wall time of this build.
    warnings
        What a person should know before trusting the atlas.
    """

    path: Path
    atlas_id: str
    entries: int
    resumed: int
    solver: str
    residual: float
    variable_normals: tuple[int, ...]
    diagnostics: NDArray
    largest_shift: NDArray[np.float32]
    craniotomy_shift: NDArray[np.float32] | None
    times_s: Mapping[str, float]
    wall_s: float
    warnings: tuple[str, ...]


def build_atlas(
    patient: PatientModel,
    scene: Scene,
    output: str | Path,
    *,
    materials: Mapping[Tissue, TissueProperties] = TABLE_1,
    solver: SolverName = "auto",
    scheduler: str | None = None,
    fresh: bool = False,
    progress: Progress | None = None,
) -> BuildReport:
    """Solve all entries of a scene and write the atlas.

    A build that was interrupted, however, resumes where it was when the same one is started again: solved jobs lie in a
    hidden folder beside the output until the atlas is written.

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
    scheduler
        Address of a dask.distributed scheduler whose workers solve the jobs; None solves them in this process.
    fresh
        Start anew, whatever an interrupted build has left.
    progress
        Called with a stage and the fraction of the build that is done.

    Raises
    ------
    InputError
        The scene asks for what is not modelled, the patient's mesh cannot be solved, another process is building the same
        file, or the scheduler cannot be used.
    ArithmeticError
        A residual is too large.
    """
    start = perf_counter()
    report = progress if progress is not None else _silent
    entries = entries_of(scene)
    jobs = jobs_of(entries)
    writable_target(output)
    _refuse_without_tumor(patient, scene)
    directions = tuple(dict.fromkeys(entry.gravity_direction for entry in entries))
    problem = Problem(patient.mesh, patient.tissue, scene, materials, directions, solver)
    times_s: dict[str, float] = {}
    with building_folder(output, key_of(patient, scene, materials, jobs), fresh=fresh) as folder:
        results = folder.resume(jobs, len(patient.mesh.nodes))
        resumed = sum(len(job.entries) for job in jobs if job.number in results)
        remaining = [job for job in jobs if job.number not in results]
        begin = resumed / len(entries)

        def report_jobs(stage: str, fraction: float) -> None:
            report(stage, (1.0 - _WRITING) * (begin + (1.0 - begin) * fraction))

        for job, solved in _solve(problem, remaining, scheduler, report_jobs):
            for stage, seconds in solved.times_s.items():
                times_s[stage] = times_s.get(stage, 0.0) + seconds
            with timed(times_s, WRITE):
                results[job.number] = folder.store(job, solved)
        report(WRITE, 1.0 - _WRITING)
        with timed(times_s, WRITE):
            parts = [results[job.number] for job in jobs]
            content = _content(patient, scene, materials, entries, parts)
            atlas_id = write_atlas(output, content, _StoredMatrix(parts))
    report(WRITE, 1.0)
    assert content.diagnostics is not None
    seen = content.diagnostics["craniotomy_shift"]
    of_state = {job.resected: part for job, part in zip(jobs, parts, strict=True)}
    return BuildReport(
        path=Path(output),
        atlas_id=atlas_id,
        entries=len(entries),
        resumed=resumed,
        solver=content.solver,
        residual=float(content.diagnostics["residual"].max()),
        variable_normals=tuple(part.variable_normals for part in of_state.values()),
        diagnostics=content.diagnostics,
        largest_shift=content.diagnostics["largest_shift"],
        craniotomy_shift=None if np.isnan(seen).any() else seen,
        times_s=times_s,
        wall_s=perf_counter() - start,
        warnings=(
            *folder.warnings,
            *_remarks(patient.mesh, scene),
            *(warning for part in of_state.values() for warning in part.warnings),
            *limits_of_linear_theory(entries, content.diagnostics),
        ),
    )


def _solve(problem: Problem, jobs: Sequence[Job], scheduler: str | None, report: Progress) -> Iterator[tuple[Job, SolvedJob]]:
    """Solve jobs here or on the scheduler's workers."""
    if not jobs:
        return
    if scheduler is None:
        yield from solve_here(problem, jobs, report)
        return
    # dask takes a second to import, which a build on this machine need not wait for.
    from brainshift_ros.atlas.cluster import solve_on_cluster

    yield from solve_on_cluster(scheduler, problem, jobs, report)


def _content(
    patient: PatientModel,
    scene: Scene,
    materials: Mapping[Tissue, TissueProperties],
    entries: tuple[AtlasEntry, ...],
    parts: Sequence[SolvedJob],
) -> AtlasContent:
    """Everything that the file holds beside its matrix."""
    return AtlasContent(
        patient_id=patient.patient_id,
        mesh=patient.mesh,
        tissue=patient.tissue,
        scene=scene,
        entries=entries,
        groups=groups_of(entries, scene.weight_sums),
        materials=materials,
        diagnostics=np.concatenate([part.diagnostics for part in parts]),
        solver=", ".join(sorted({part.solver for part in parts})),
    )


class _StoredMatrix:
    """The matrix of an atlas as its jobs left it on the disk, read by rows."""

    def __init__(self, parts: Sequence[SolvedJob]) -> None:
        self._parts = [part.columns for part in parts]
        self.shape = (len(self._parts[0]), 3, sum(part.shape[2] for part in self._parts))
        self.dtype = np.dtype(np.float32)

    def __getitem__(self, nodes: slice) -> NDArray[np.float32]:
        return np.concatenate([part[nodes] for part in self._parts], axis=2)


def _refuse_without_tumor(patient: PatientModel, scene: Scene) -> None:
    """Refuse what needs a tumour, before the entries that need none are solved."""
    if (patient.tissue == Tissue.TUMOR).any():
        return
    if scene.resection != "none":
        problem, key = "has no tumour to resect", "set `resection: none`"
    elif scene.swelling is not None:
        problem, key = "has no tumour whose surroundings could swell", "leave `swelling` out"
    else:
        return
    raise InputError("patient", problem, f"give a tumour to `brainshift patient`, or {key} in the scene")


def _remarks(mesh: TetMesh, scene: Scene) -> tuple[str, ...]:
    """Say where the scene asks for what this patient's mesh does not have."""
    remarks = []
    if scene.septa and not any(len(mesh.facets.get(sheet, ())) for sheet in SHEETS):
        remarks.append("the scene asks for septa, but the patient's mesh has none: the brain was solved as one body")
    opening = under_craniotomy(mesh, scene.craniotomy)
    if scene.craniotomy is not None and opening is not None and not opening.any():
        remarks.append(f"no cortex lies under the craniotomy at {scene.craniotomy.center_mm} mm: check its centre")
    if scene.swelling is not None and scene.swelling.pressure_levels > 1:
        # Linear theory from rest, with skull contact too, whose conditions are a cone: twice the pressure, twice the shift.
        remarks.append("the swelling's levels are scaled copies of one another, which weights from 0 to 1 span: one would do")
    return tuple(remarks)


def _silent(stage: str, fraction: float) -> None:
    pass

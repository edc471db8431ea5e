"""The folder beside an atlas under construction: what was solved survives a kill at any moment, and the build resumes there.

A job's columns are written, flushed to the disk and renamed into place; then its record is, in the same way. A record thus
vouches for columns that are whole; its checksums are looked at again on resuming. Plain files instead of one memory-mapped
matrix: a full disk then raises an error, where a page that cannot be stored would end the process without a word.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros import __version__
from brainshift_ros.atlas.diagnostics import DIAGNOSTICS
from brainshift_ros.atlas.jobs import Job, SolvedJob
from brainshift_ros.atlas.lock import LOCK, held
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.files import remove_unfinished
from brainshift_ros.h5 import digest, digest_of_mesh
from brainshift_ros.mechanics.materials import TissueProperties
from brainshift_ros.mesh.patient import PatientModel, Tissue

_KEY = "key.json"


def key_of(
    patient: PatientModel, scene: Scene, materials: Mapping[Tissue, TissueProperties], jobs: Sequence[Job]
) -> dict[str, Any]:
    """Everything that decides what the jobs of a build give, as far as a resumed build must agree on it.

    The solver does not count: all give the same solutions to within the residual.
    """
    return {
        "software": f"brainshift_ros {__version__}",
        "patient": digest(patient.patient_id, digest_of_mesh(patient.mesh), patient.tissue),
        "scene": scene.model_dump(mode="json"),
        "materials": {tissue.name.lower(): asdict(properties) for tissue, properties in materials.items()},
        "jobs": [len(job.entries) for job in jobs],
    }


def building_path(output: str | Path) -> Path:
    """Where the building folder of an atlas lies: beside it, hidden."""
    output = Path(output)
    return output.with_name(f".{output.name}.building")


@contextmanager
def building_folder(output: str | Path, key: Mapping[str, Any], *, fresh: bool = False) -> Iterator[BuildingFolder]:
    """Open the building folder of an atlas and hold it, so that no other process builds the same file.

    It stays behind when the block fails and some job was stored; it goes when the block ends well or nothing is in it.

    Parameters
    ----------
    output
        The atlas file.
    key
        From :func:`key_of`. What another key left behind is removed.
    fresh
        Remove what the same key left behind as well.

    Raises
    ------
    InputError
        Another process is building this atlas.
    """
    path = building_path(output)
    with held(path, output):
        # A build that was killed while it wrote the atlas left half of it; the lock says that it is gone.
        remove_unfinished(output)
        folder = BuildingFolder(path, key, fresh)
        try:
            yield folder
        except BaseException:
            if not any(path.glob("*.json.done")):
                _empty(path)
            raise
        _empty(path)


class BuildingFolder:
    """Stores solved jobs, and finds them again.

    Attributes
    ----------
    warnings
        What was found in the folder and could not be used.
    """

    def __init__(self, path: Path, key: Mapping[str, Any], fresh: bool) -> None:
        self._path = path
        text = _text(key)
        self.warnings: tuple[str, ...] = ()
        key_path = path / _KEY
        found = key_path.read_text(encoding="utf-8") if key_path.exists() else None
        if found is not None and found != text:
            self.warnings = (f"an unfinished build of {_differences(found, key)} was discarded",)
        if fresh or found != text:
            _empty(path, keep_lock=True)
            _write(key_path, text.encode())

    def resume(self, jobs: Sequence[Job], nodes: int) -> dict[int, SolvedJob]:
        """Jobs that were stored earlier, by number, with their columns memory-mapped; what does not check out is dropped."""
        found = {}
        for job in jobs:
            with suppress(FileNotFoundError):
                try:
                    found[job.number] = self._read(job, nodes)
                except (ValueError, KeyError, TypeError) as error:
                    self.warnings += (f"what was kept of job {job.number} is damaged ({error}); it is solved again",)
        return found

    def store(self, job: Job, solved: SolvedJob) -> SolvedJob:
        """Store a job; the same job with its columns memory-mapped, so that a build need not hold the matrix in memory."""
        columns = np.ascontiguousarray(solved.columns)
        _write(self._columns_path(job), columns.data)
        record = {
            "first": job.first,
            "columns": digest(columns),
            "diagnostics": solved.diagnostics.tolist(),
            "solver": solved.solver,
            "variable_normals": solved.variable_normals,
            "warnings": list(solved.warnings),
            "times_s": dict(solved.times_s),
        }
        text = json.dumps(record)
        _write(self._record_path(job), f"{digest(text)}\n{text}".encode())
        return replace(solved, columns=self._map(job, len(columns)))

    def _read(self, job: Job, nodes: int) -> SolvedJob:
        checksum, _, text = self._record_path(job).read_text(encoding="utf-8").partition("\n")
        if checksum != digest(text):
            raise ValueError("its record does not match its checksum")
        record = json.loads(text)
        columns = self._map(job, nodes)
        if record["first"] != job.first or digest(columns) != record["columns"]:
            raise ValueError("its columns do not match their checksum")
        return SolvedJob(
            columns=columns,
            diagnostics=np.array([tuple(row) for row in record["diagnostics"]], dtype=DIAGNOSTICS),
            solver=record["solver"],
            variable_normals=record["variable_normals"],
            warnings=tuple(record["warnings"]),
            times_s=record["times_s"],
        )

    def _map(self, job: Job, nodes: int) -> NDArray[np.float32]:
        return np.memmap(self._columns_path(job), dtype=np.float32, mode="r", shape=(nodes, 3, len(job.entries)))

    def _columns_path(self, job: Job) -> Path:
        return self._path / f"job-{job.number}.columns"

    def _record_path(self, job: Job) -> Path:
        return self._path / f"job-{job.number}.json.done"


def _empty(folder: Path, *, keep_lock: bool = False) -> None:
    """Remove what a folder holds, the lock last and then the folder, unless the lock shall stay."""
    for path in folder.iterdir():
        if path.name == LOCK:
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    if not keep_lock:
        (folder / LOCK).unlink()
        with suppress(OSError):  # the next build may have made its lock already
            folder.rmdir()


def _write(path: Path, content: bytes | memoryview) -> None:
    """Write a file whole or not at all, and onto the disk before it gets its name."""
    temporary = path.with_name(path.name + ".part")
    with open(temporary, "wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _differences(found: str, key: Mapping[str, Any]) -> str:
    """Name what an earlier build had different."""
    try:
        earlier = json.loads(found)
        names = [name for name in key if _text(earlier[name]) != _text(key[name])]
    except (ValueError, KeyError, TypeError):
        return "unknown origin"
    return f"another {' and '.join(names)}"


def _text(value: object) -> str:
    return json.dumps(value, sort_keys=True)

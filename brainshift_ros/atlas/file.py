"""The atlas file (spec P10): HDF5, one file per patient, validated on opening."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path
from brainshift_ros.h5 import digest, open_checked, read_mesh, write_header, write_mesh
from brainshift_ros.mechanics.materials import TABLE_1, TissueProperties
from brainshift_ros.mesh.patient import Tissue
from brainshift_ros.mesh.tetmesh import TetMesh

KIND = "atlas"
VERSION = 1
INFO_SCHEMA = "brainshift/atlas-info/1"

#: Chunk of E in nodes and columns: 48 KiB. Rows of scattered nodes touch one short chunk each for 64 columns; whole columns
#: stream through chunks that hold them.
CHUNK_NODES, CHUNK_COLUMNS = 64, 64

_ENTRY = np.dtype(
    [
        ("mechanism", h5py.string_dtype("utf-8", 16)),
        ("gravity_direction", np.float64, (3,)),
        ("fluid_level", np.float64),
        ("drug_level", np.int32),
        ("resected", np.bool_),
    ]
)


@dataclass(frozen=True)
class AtlasContent:
    """What an atlas file holds beside its matrix.

    Attributes
    ----------
    patient_id
        Of the patient model that the atlas was built for.
    mesh
        That patient's mesh; row i of E belongs to its node i.
    tissue
        Shape (M,), :class:`~brainshift_ros.mesh.patient.Tissue` of each element.
    scene
        The scene that was solved.
    entries
        Parameters of each column.
    groups
        Columns whose weights share a sum limit.
    materials
        Properties of each tissue.
    """

    patient_id: str
    mesh: TetMesh
    tissue: NDArray[np.uint8]
    scene: Scene
    entries: tuple[AtlasEntry, ...]
    groups: tuple[WeightGroup, ...]
    materials: Mapping[Tissue, TissueProperties] = field(default_factory=lambda: TABLE_1)


def write_atlas(path: str | Path, content: AtlasContent, E: NDArray[np.float32]) -> str:
    """Write an atlas whole or not at all.

    Parameters
    ----------
    path
        Where to.
    content
        Everything but the matrix.
    E
        Shape (N, 3, m), displacement of each node for each entry, m.

    Returns
    -------
    The atlas's id.

    Raises
    ------
    ValueError
        The matrix does not fit mesh and entries, or is not finite.
    """
    shape = (len(content.mesh.nodes), 3, len(content.entries))
    if E.shape != shape or E.dtype != np.float32:
        raise ValueError(f"E is {E.shape} {E.dtype}, mesh and entries need {shape} float32")
    if not np.isfinite(E).all():
        raise ValueError("E holds values that are not finite")
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        write_header(file, KIND, VERSION)
        file.attrs["created"] = datetime.now(UTC).isoformat(timespec="seconds")
        file.attrs["patient_id"] = content.patient_id
        file.attrs["scene"] = content.scene.model_dump_json()
        file.attrs["groups"] = json.dumps([asdict(group) for group in content.groups])
        file.attrs["materials"] = json.dumps({t.name.lower(): asdict(p) for t, p in content.materials.items()})
        write_mesh(file.create_group("mesh"), content.mesh)
        file["tissue"] = content.tissue
        file["entries"] = _to_table(content.entries)
        chunks = (min(CHUNK_NODES, shape[0]), 3, min(CHUNK_COLUMNS, shape[2]))
        file.create_dataset("E", data=E, chunks=chunks)
        blocks = [digest(E[:, :, start : start + CHUNK_COLUMNS]) for start in range(0, shape[2], CHUNK_COLUMNS)]
        file["E_sha256"] = np.array(blocks, dtype="S64")
        atlas_id = _atlas_id(file, blocks)
        file.attrs["atlas_id"] = atlas_id
    return atlas_id


def open_atlas(path: str | Path) -> AtlasFile:
    """Open an atlas and validate all of it.

    Raises
    ------
    InputError
        The file is missing, foreign, cut off, of another version, incomplete, or was changed.
    """
    file = open_checked(path, KIND, VERSION)
    try:
        return AtlasFile(file)
    except InputError:
        file.close()
        raise
    except (KeyError, OSError, ValueError, TypeError, RuntimeError, ValidationError) as error:
        file.close()
        raise InputError(path, f"its content cannot be read ({error})", "make the atlas again") from error


class AtlasFile:
    """An open, validated atlas; use as a context manager.

    Attributes
    ----------
    path
        Of the file.
    atlas_id, patient_id
        Hex SHA-256 of the atlas's content, and of the patient model that it was built for.
    mesh
        The patient's mesh.
    tissue
        Shape (M,), tissue class of each element.
    scene, entries, groups
        What was solved, the parameters of each column, and the columns whose weights share a sum limit.
    materials
        Properties of each tissue.
    software, created
        What wrote the file, and when (ISO 8601, UTC).
    """

    def __init__(self, file: h5py.File) -> None:
        self._file = file
        self.path = Path(file.filename).absolute()
        self.atlas_id = str(file.attrs["atlas_id"])
        self.patient_id = str(file.attrs["patient_id"])
        self.software = str(file.attrs["software"])
        self.created = str(file.attrs["created"])
        self.scene = Scene.model_validate_json(str(file.attrs["scene"]))
        self.groups = tuple(
            WeightGroup(str(g["name"]), tuple(int(c) for c in g["columns"]), float(g["sum_limit"]))
            for g in json.loads(str(file.attrs["groups"]))
        )
        # An atlas without this attribute was built with table 1, which nothing could change then.
        self.materials: Mapping[Tissue, TissueProperties] = TABLE_1
        if "materials" in file.attrs:
            content = json.loads(str(file.attrs["materials"]))
            self.materials = {Tissue[name.upper()]: TissueProperties(**values) for name, values in content.items()}
        self.entries = _from_table(file["entries"][()])
        self.mesh = read_mesh(file["mesh"])
        self.tissue: NDArray[np.uint8] = file["tissue"][()]
        self._E: h5py.Dataset = file["E"]
        self._validate()

    def rows(self, node_ids: ArrayLike) -> NDArray[np.float32]:
        """Read all entries at some nodes, any order, repeats allowed: (n, 3, m), m."""
        ids = self._checked(node_ids, len(self.mesh.nodes), "node")
        if len(ids) * 8 > len(self.mesh.nodes):
            return self._E[()][ids]  # HDF5 picks long lists of rows more slowly than it reads everything
        unique, inverse = np.unique(ids, return_inverse=True)
        return self._E[unique][inverse]

    def columns(self, column_ids: ArrayLike) -> NDArray[np.float32]:
        """Read some entries at all nodes, any order, repeats allowed: (N, 3, k), m."""
        ids = self._checked(column_ids, len(self.entries), "column")
        unique, inverse = np.unique(ids, return_inverse=True)
        return self._E[:, :, unique][:, :, inverse]

    def info(self) -> dict[str, Any]:
        """Say what `atlas/info` announces, as plain JSON; its schema is ``atlas/info.schema.json``."""
        return {
            "schema": INFO_SCHEMA,
            "path": str(self.path),
            "atlas_id": self.atlas_id,
            "patient_id": self.patient_id,
            "nodes": len(self.mesh.nodes),
            "elements": len(self.mesh.elements),
            "entries": len(self.entries),
            "mechanisms": sorted({entry.mechanism for entry in self.entries}),
            "groups": [{"name": g.name, "columns": list(g.columns), "sum_limit": g.sum_limit} for g in self.groups],
            "scene": self.scene.model_dump(mode="json"),
            "software": self.software,
            "created": self.created,
        }

    def close(self) -> None:
        """Close the file; rows and columns cannot be read any more."""
        self._file.close()

    def __enter__(self) -> AtlasFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _validate(self) -> None:
        shape = (len(self.mesh.nodes), 3, len(self.entries))
        if self._E.shape != shape or self._E.dtype != np.float32:
            problem = f"its matrix is {self._E.shape} {self._E.dtype}, mesh and entries need {shape} float32"
            raise InputError(self.path, problem, "make the atlas again")
        if self.tissue.shape != (len(self.mesh.elements),):
            raise InputError(self.path, "its tissue does not fit its mesh", "make the atlas again")
        if any(not 0 <= column < shape[2] for group in self.groups for column in group.columns):
            raise InputError(self.path, "a weight group names a column that it does not have", "make the atlas again")
        blocks = [block.decode() for block in self._file["E_sha256"][()]]
        starts = range(0, shape[2], CHUNK_COLUMNS)
        if len(blocks) != len(starts):
            raise InputError(self.path, "checksums of its matrix are missing", "make the atlas again")
        for start, expected in zip(starts, blocks, strict=True):
            end = min(start + CHUNK_COLUMNS, shape[2])
            if digest(self._E[:, :, start:end]) != expected:
                problem = f"columns {start} to {end - 1} of its matrix do not match their checksum"
                raise InputError(self.path, problem, "the file was changed or damaged; make the atlas again")
        if _atlas_id(self._file, blocks) != self.atlas_id:
            raise InputError(self.path, "its content does not match its id", "the file was changed; make the atlas again")

    def _checked(self, ids: ArrayLike, count: int, what: str) -> NDArray[np.int64]:
        checked = np.atleast_1d(np.asarray(ids))
        if checked.size == 0:
            return np.zeros(0, dtype=np.int64)
        if checked.ndim != 1 or not np.issubdtype(checked.dtype, np.integer):
            raise IndexError(f"{what} ids must be a list of integers, not {checked.dtype} of shape {checked.shape}")
        if checked.min() < 0 or checked.max() >= count:
            raise IndexError(f"{what} ids run from {checked.min()} to {checked.max()}, the atlas has {count}")
        return checked.astype(np.int64)


def _to_table(entries: Sequence[AtlasEntry]) -> NDArray:
    rows = [(e.mechanism.encode(), e.gravity_direction, e.fluid_level, e.drug_level, e.resected) for e in entries]
    return np.array(rows, dtype=_ENTRY)


def _from_table(table: NDArray) -> tuple[AtlasEntry, ...]:
    return tuple(
        AtlasEntry(
            mechanism=row["mechanism"].decode(),
            gravity_direction=tuple(float(x) for x in row["gravity_direction"]),  # type: ignore[arg-type]
            fluid_level=float(row["fluid_level"]),
            drug_level=int(row["drug_level"]),
            resected=bool(row["resected"]),
        )
        for row in table
    )


def _atlas_id(file: h5py.File, blocks: Sequence[str]) -> str:
    """Hash of everything that decides what the atlas says; when and by which version it was written does not count."""
    entries = _from_table(file["entries"][()])
    parts = (
        str(file.attrs["patient_id"]),
        str(file.attrs["scene"]),
        str(file.attrs["groups"]),
        json.dumps([asdict(entry) for entry in entries]),
        *([str(file.attrs["materials"])] if "materials" in file.attrs else []),
        *blocks,
    )
    return digest(str(file["mesh"].attrs["sha256"]), file["tissue"][()], *parts)

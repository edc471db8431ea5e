"""The atlas file (spec P10): HDF5, one file per patient, validated on opening."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from brainshift_ros.atlas.contiguous import read_columns
from brainshift_ros.atlas.diagnostics import DIAGNOSTICS
from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.atlas.table import from_table, to_table
from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path
from brainshift_ros.h5 import digest, open_checked, read_mesh, write_header, write_mesh
from brainshift_ros.mechanics.materials import TABLE_1, TissueProperties
from brainshift_ros.mesh.patient import Tissue
from brainshift_ros.mesh.tetmesh import TetMesh

KIND = "atlas"
VERSION = 2
INFO_SCHEMA = "brainshift/atlas-info/1"

#: Nodes that are written, and checked on opening, together. The matrix itself is one contiguous array with the entries of a
#: node side by side. On 19,284 nodes and 720 entries that reads 300 scattered nodes in 6 ms and 10 scattered entries in
#: 18 to 40 ms; in chunks of 64 nodes and 64 entries, 260 and 610 ms.
BLOCK_NODES = 1024


class RowSource(Protocol):
    """A matrix E (N, 3, m) that gives blocks of rows: an array, or columns that lie on the disk."""

    @property
    def shape(self) -> tuple[int, ...]:
        """N, 3, m."""

    @property
    def dtype(self) -> np.dtype:
        """Single precision, float32."""

    def __getitem__(self, nodes: slice, /) -> NDArray[np.float32]:
        """Rows of some neighbouring nodes, (n, 3, m)."""


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
    diagnostics
        Shape (m,), how each entry's solution came about; see :mod:`brainshift_ros.atlas.diagnostics`. None if unknown.
    solver
        Name of the linear solver that made it.
    """

    patient_id: str
    mesh: TetMesh
    tissue: NDArray[np.uint8]
    scene: Scene
    entries: tuple[AtlasEntry, ...]
    groups: tuple[WeightGroup, ...]
    materials: Mapping[Tissue, TissueProperties] = field(default_factory=lambda: TABLE_1)
    diagnostics: NDArray | None = None
    solver: str = "unknown"


def write_atlas(path: str | Path, content: AtlasContent, E: RowSource) -> str:
    """Write an atlas whole or not at all.

    Parameters
    ----------
    path
        Where to.
    content
        Everything but the matrix.
    E
        Shape (N, 3, m), displacement of each node for each entry, m. It is read block by block.

    Returns
    -------
    The atlas's id.

    Raises
    ------
    ValueError
        The matrix or the diagnostics do not fit mesh and entries, or the matrix is not finite.
    """
    shape = (len(content.mesh.nodes), 3, len(content.entries))
    if E.shape != shape or E.dtype != np.float32:
        raise ValueError(f"E is {E.shape} {E.dtype}, mesh and entries need {shape} float32")
    if content.diagnostics is not None and content.diagnostics.shape != shape[2:]:
        raise ValueError(f"there are {shape[2]} entries, but diagnostics of {len(content.diagnostics)}")
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        write_header(file, KIND, VERSION)
        file.attrs["created"] = datetime.now(UTC).isoformat(timespec="seconds")
        file.attrs["patient_id"] = content.patient_id
        file.attrs["scene"] = content.scene.model_dump_json()
        file.attrs["groups"] = json.dumps([asdict(group) for group in content.groups])
        file.attrs["materials"] = json.dumps({t.name.lower(): asdict(p) for t, p in content.materials.items()})
        file.attrs["solver"] = content.solver
        write_mesh(file.create_group("mesh"), content.mesh)
        file["tissue"] = content.tissue
        file["entries"] = to_table(content.entries, content.materials)
        if content.diagnostics is not None:
            file["diagnostics"] = content.diagnostics
        matrix = file.create_dataset("E", shape=shape, dtype=np.float32)
        blocks = []
        for start in range(0, shape[0], BLOCK_NODES):
            rows = np.ascontiguousarray(E[start : start + BLOCK_NODES])
            if not np.isfinite(rows).all():
                raise ValueError("E holds values that are not finite")
            matrix[start : start + BLOCK_NODES] = rows
            blocks.append(digest(rows))
        file["E_sha256"] = np.array(blocks, dtype="S64")
        file.attrs["atlas_id"] = _atlas_id(file, blocks)
        file.attrs["remarks_sha256"] = _remarks_digest(file)
        return str(file.attrs["atlas_id"])


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
    diagnostics
        Shape (m,), how each entry's solution came about; see :mod:`brainshift_ros.atlas.diagnostics`. None if unknown.
    solver
        Name of the linear solver that made it.
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
        materials = json.loads(str(file.attrs["materials"]))
        self.materials: Mapping[Tissue, TissueProperties] = {
            Tissue[name.upper()]: TissueProperties(**values) for name, values in materials.items()
        }
        self.solver = str(file.attrs["solver"])
        self.diagnostics: NDArray | None = file["diagnostics"][()] if "diagnostics" in file else None
        self.entries = from_table(file["entries"][()])
        self.mesh = read_mesh(file["mesh"])
        self.tissue: NDArray[np.uint8] = file["tissue"][()]
        self._E: h5py.Dataset = file["E"]
        self._validate()

    def rows(self, node_ids: ArrayLike) -> NDArray[np.float32]:
        """Read all entries at some nodes, any order, repeats allowed: (n, 3, m), m."""
        ids = self._checked(node_ids, len(self.mesh.nodes), "node")
        if len(ids) * 8 > len(self.mesh.nodes):  # HDF5 picks long lists of rows more slowly than it reads everything
            rows = np.empty((len(ids), 3, len(self.entries)), dtype=np.float32)
            for start in range(0, len(self.mesh.nodes), BLOCK_NODES):
                here = np.flatnonzero((ids >= start) & (ids < start + BLOCK_NODES))
                rows[here] = self._E[start : start + BLOCK_NODES][ids[here] - start]
            return rows
        unique, inverse = np.unique(ids, return_inverse=True)
        return self._E[unique][inverse]

    def columns(self, column_ids: ArrayLike) -> NDArray[np.float32]:
        """Read some entries at all nodes, any order, repeats allowed: (N, 3, k), m."""
        ids = self._checked(column_ids, len(self.entries), "column")
        try:
            return read_columns(self._E, ids)
        except OSError as error:
            raise InputError(self.path, f"its matrix cannot be read ({error})", "make the atlas again") from error

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
        if not all(0.0 < group.sum_limit < np.inf for group in self.groups):
            raise InputError(self.path, "the sum limit of a weight group is not positive", "make the atlas again")
        if self.diagnostics is not None and (self.diagnostics.shape != shape[2:] or self.diagnostics.dtype != DIAGNOSTICS):
            raise InputError(self.path, "its diagnostics do not fit its entries", "make the atlas again")
        blocks = [block.decode() for block in self._file["E_sha256"][()]]
        starts = range(0, shape[0], BLOCK_NODES)
        if len(blocks) != len(starts):
            raise InputError(self.path, "checksums of its matrix are missing", "make the atlas again")
        for start, expected in zip(starts, blocks, strict=True):
            end = min(start + BLOCK_NODES, shape[0])
            if digest(self._E[start:end]) != expected:
                problem = f"rows of nodes {start} to {end - 1} of its matrix do not match their checksum"
                raise InputError(self.path, problem, "the file was changed or damaged; make the atlas again")
        if _atlas_id(self._file, blocks) != self.atlas_id:
            raise InputError(self.path, "its content does not match its id", "the file was changed; make the atlas again")
        if _remarks_digest(self._file) != self._file.attrs["remarks_sha256"]:
            problem = "its diagnostics do not match their checksum"
            raise InputError(self.path, problem, "the file was changed or damaged; make the atlas again")

    def _checked(self, ids: ArrayLike, count: int, what: str) -> NDArray[np.int64]:
        checked = np.atleast_1d(np.asarray(ids))
        if checked.size == 0:
            return np.zeros(0, dtype=np.int64)
        if checked.ndim != 1 or not np.issubdtype(checked.dtype, np.integer):
            raise IndexError(f"{what} ids must be a list of integers, not {checked.dtype} of shape {checked.shape}")
        if checked.min() < 0 or checked.max() >= count:
            raise IndexError(f"{what} ids run from {checked.min()} to {checked.max()}, the atlas has {count}")
        return checked.astype(np.int64)


def _atlas_id(file: h5py.File, blocks: Sequence[str]) -> str:
    """Hash of everything that decides what the atlas says; when, how and by which version it was made does not count."""
    parts = (*(str(file.attrs[name]) for name in ("patient_id", "scene", "groups", "materials")), *blocks)
    return digest(str(file["mesh"].attrs["sha256"]), file["tissue"][()], file["entries"][()], *parts)


def _remarks_digest(file: h5py.File) -> str:
    """Hash of what the file says of how it was made."""
    table = file["diagnostics"][()] if "diagnostics" in file else "none"
    return digest(*(str(file.attrs[name]) for name in ("solver", "created", "software")), table)

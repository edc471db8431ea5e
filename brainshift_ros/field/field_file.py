"""The field file: a displacement field with its mesh and provenance, as HDF5."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.files import atomic_path
from brainshift_ros.h5 import digest, open_checked, read_mesh, write_header, write_mesh

KIND = "field"
VERSION = 1


def write_field(path: str | Path, field: DisplacementField) -> None:
    """Write a field; the file appears whole or not at all.

    Raises
    ------
    InputError
        The folder does not exist.
    """
    provenance = json.dumps(dict(field.provenance), sort_keys=True)
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        write_header(file, KIND, VERSION)
        write_mesh(file.create_group("mesh"), field.mesh)
        file["displacement"] = field.displacement
        file["std"] = field.std
        file.attrs["provenance"] = provenance
        file.attrs["sha256"] = digest(field.displacement, field.std, provenance)


def read_field(path: str | Path) -> DisplacementField:
    """Read a field that :func:`write_field` wrote.

    Raises
    ------
    InputError
        Missing, cut off, not a field file, of another version, incomplete, damaged, or not finite.
    """
    with open_checked(path, KIND, VERSION) as file:
        if "mesh" not in file:
            raise InputError(path, "has no mesh", "make the field file again")
        mesh = read_mesh(file["mesh"])
        try:
            displacement, std = file["displacement"][()], file["std"][()]
            text, expected = str(file.attrs["provenance"]), str(file.attrs["sha256"])
            provenance: dict[str, Any] = json.loads(text)
        except (KeyError, OSError, ValueError) as error:
            raise InputError(path, f"its displacement cannot be read ({error})", "make the field file again") from error
    if digest(displacement, std, text) != expected:
        raise InputError(path, "its displacement does not match its checksum", "the file was changed or damaged; make it again")
    count = len(mesh.nodes)
    if displacement.shape != (count, 3) or std.shape != (count,):
        problem = f"holds {displacement.shape} displacements and {std.shape} deviations for {count} nodes"
        raise InputError(path, problem, "make the field file again")
    if not (np.isfinite(displacement).all() and np.isfinite(std).all()):
        raise InputError(path, "holds values that are not finite", "make the field file again")
    return DisplacementField(mesh, displacement, std, provenance)

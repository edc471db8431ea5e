"""What all HDF5 files of the project share: a header, checked on opening, and checksums of arrays."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from brainshift_ros import __version__
from brainshift_ros.errors import InputError
from brainshift_ros.files import existing_file
from brainshift_ros.mesh.tetmesh import TetMesh


def write_header(file: h5py.File, kind: str, version: int) -> None:
    """Stamp a new file with its kind (``patient``, ``atlas``, ``field``), format version and software version."""
    file.attrs["format"] = f"brainshift/{kind}"
    file.attrs["version"] = version
    file.attrs["software"] = f"brainshift_ros {__version__}"


def open_checked(path: str | Path, kind: str, version: int) -> h5py.File:
    """Open a file of the project for reading.

    Raises
    ------
    InputError
        Missing, not HDF5, cut off, of another kind or of another format version.
    """
    path = existing_file(path, f"brainshift {kind} file (HDF5)")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        problem = f"is not a readable HDF5 file, or it is cut off ({error})"
        raise InputError(path, problem, f"make the {kind} file again") from error
    found = file.attrs.get("format", "none")
    if found != f"brainshift/{kind}":
        file.close()
        raise InputError(path, f"is not a brainshift {kind} file (format: {found})", f"give a file made by `brainshift {kind}`")
    found_version = int(file.attrs.get("version", -1))
    if found_version != version:
        file.close()
        problem = f"has format version {found_version}, this software reads {version}"
        raise InputError(path, problem, f"make the {kind} file again")
    return file


def digest(*arrays: NDArray | str) -> str:
    """Hex SHA-256 over the dtype, shape and bytes of arrays and over strings, in order."""
    sha = hashlib.sha256()
    for array in arrays:
        if isinstance(array, str):
            sha.update(array.encode())
        else:
            contiguous = np.ascontiguousarray(array)
            sha.update(f"{contiguous.dtype.str}{contiguous.shape}".encode())
            sha.update(contiguous.data)
    return sha.hexdigest()


def digest_of_mesh(mesh: TetMesh) -> str:
    """Hex SHA-256 of a mesh with its named sets."""
    named: Mapping[str, NDArray] = {**mesh.facets, **mesh.node_sets}
    return digest(mesh.nodes, mesh.elements, mesh.region, *(item for name in sorted(named) for item in (name, named[name])))


def write_mesh(group: h5py.Group, mesh: TetMesh) -> None:
    """Store a mesh in a group, with its checksum."""
    group["nodes"] = mesh.nodes
    group["elements"] = mesh.elements
    group["region"] = mesh.region
    for name, facets in mesh.facets.items():
        group[f"facets/{name}"] = facets
    for name, ids in mesh.node_sets.items():
        group[f"node_sets/{name}"] = ids
    group.attrs["sha256"] = digest_of_mesh(mesh)


def read_mesh(group: h5py.Group) -> TetMesh:
    """Read a mesh that :func:`write_mesh` stored.

    Raises
    ------
    InputError
        A dataset is missing or the checksum does not match.
    """
    source = group.file.filename
    try:
        mesh = TetMesh(
            nodes=group["nodes"][()],
            elements=group["elements"][()],
            region=group["region"][()],
            facets={name: data[()] for name, data in group.get("facets", {}).items()},
            node_sets={name: data[()] for name, data in group.get("node_sets", {}).items()},
        )
        expected = group.attrs["sha256"]
    except (KeyError, OSError) as error:
        raise InputError(source, f"its mesh cannot be read ({error})", "make the file again") from error
    if digest_of_mesh(mesh) != expected:
        raise InputError(source, "its mesh does not match its checksum", "the file was changed or damaged; make it again")
    return mesh

"""The patient file (HDF5): mesh, tissue, cortex, the image's identity, quality."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path
from brainshift_ros.h5 import digest, digest_of_mesh, open_checked, read_mesh, write_header, write_mesh
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.segmentation.template_map import TemplateMap
from brainshift_ros.surface.surface import Surface

KIND, VERSION = "patient", 1
_REMEDY = "the file was changed or damaged; make it again with `brainshift patient`"


def patient_digest(mesh: TetMesh, tissue: np.ndarray, cortex: Surface, image: ImageReference) -> str:
    """Hex SHA-256 over what determines results: mesh, tissue, cortex, and the image's hash and grid."""
    return digest(digest_of_mesh(mesh), tissue, cortex.vertices, cortex.faces, image.sha256, image.T_patient_voxel)


def write_patient(path: str | Path, patient: PatientModel) -> None:
    """Write a patient model; the file appears whole or not at all."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        write_header(file, KIND, VERSION)
        file.attrs["patient_id"] = patient.patient_id
        write_mesh(file.create_group("mesh"), patient.mesh)
        file["tissue"] = patient.tissue
        file.create_dataset("cortex/vertices", data=patient.cortex.vertices, compression="lzf")
        file.create_dataset("cortex/faces", data=patient.cortex.faces, compression="lzf")
        image = file.create_group("image")
        image.attrs["name"] = patient.image.name
        image.attrs["sha256"] = patient.image.sha256
        image.attrs["shape"] = patient.image.shape
        image["T_patient_voxel"] = patient.image.T_patient_voxel
        quality = file.create_group("quality")
        for name, value in patient.quality.items():
            quality.attrs[name] = value
        if patient.template_map is not None:
            group = file.create_group("template_map")
            for field in fields(TemplateMap):
                data = getattr(patient.template_map, field.name)
                group.create_dataset(field.name, data=data, compression="gzip" if data.ndim > 2 else None)
        file.attrs.create("warnings", list(patient.warnings), dtype=h5py.string_dtype())


def read_patient(path: str | Path) -> PatientModel:
    """Read a patient model.

    Raises
    ------
    InputError
        Missing, not HDF5, cut off, of another kind or version, incomplete, or changed since it was written.
    """
    with open_checked(path, KIND, VERSION) as file:
        try:
            mesh = read_mesh(file["mesh"])
            tissue = file["tissue"][()]
            cortex = Surface(file["cortex/vertices"][()], file["cortex/faces"][()])
            attributes = file["image"].attrs
            i, j, k = (int(n) for n in attributes["shape"])
            image = ImageReference(
                str(attributes["name"]), str(attributes["sha256"]), (i, j, k), file["image/T_patient_voxel"][()]
            )
            quality = {name: float(value) for name, value in file["quality"].attrs.items()}
            warnings = tuple(str(text) for text in file.attrs["warnings"])
            template_map = _read_template_map(file)
            patient_id = str(file.attrs["patient_id"])
        except InputError:
            raise
        except (KeyError, OSError, ValueError, TypeError) as error:
            raise InputError(path, f"lacks parts of a patient model, or they cannot be read ({error})", _REMEDY) from error
    if patient_digest(mesh, tissue, cortex, image) != patient_id:
        raise InputError(path, "its content does not match its patient id", _REMEDY)
    return PatientModel(mesh, tissue, cortex, image, quality, warnings, patient_id, template_map)


def _read_template_map(file: h5py.File) -> TemplateMap | None:
    if "template_map" not in file:
        return None
    group = file["template_map"]
    return TemplateMap(**{field.name: group[field.name][()] for field in fields(TemplateMap)})

"""Patient models for studies: the template with its tumour and septa, meshed at any size, kept between runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.h5 import digest
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.patient_file import read_patient, write_patient
from brainshift_ros.mesh.template_patient import template_patient_images
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.septa.sheets import septa_spacing_mm
from brainshift_ros.simulation.targets import target_groups
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]

#: A left frontal craniotomy, as in the example scene: centre and radius.
CENTER_MM, RADIUS_MM = (-35.0, 45.0, 50.0), 35.0


def patient_path(folder: Path, nodes: int, seed: int) -> Path:
    """Where :func:`template_patient` keeps a model."""
    return folder / f"patient_{nodes}_{seed}.h5"


def template_patient(folder: Path, nodes: int, seed: int, progress: Progress) -> PatientModel:
    """Mesh the template once; later calls read the file in `folder`, which may be deleted to mesh again.

    Parameters
    ----------
    folder
        Keeps the model.
    nodes, seed
        Of the mesh; another seed gives another mesh of the same head.
    progress
        Called with stage and fraction done.
    """
    path = patient_path(folder, nodes, seed)
    if path.is_file():
        return read_patient(path)
    images = template_patient_images(septa_spacing_mm=septa_spacing_mm(nodes))
    patient = build_patient(
        images.t1,
        images.labels,
        images.septa,
        image_ref=ImageReference("template", digest(images.t1.data), images.t1.shape, images.t1.T_patient_voxel),
        nodes=nodes,
        seed=seed,
        progress=lambda stage, fraction: progress(f"{nodes} nodes: {stage}", fraction),
    )
    write_patient(path, patient)
    return patient


def craniotomy_opening(mesh: TetMesh) -> NDArray[np.bool_]:
    """Outer nodes (N,) under the craniotomy."""
    opening = np.zeros(len(mesh.nodes), dtype=bool)
    opening[np.unique(mesh.facets["skull"])] = True
    return opening & (np.linalg.norm(mesh.nodes - mm_to_m(CENTER_MM), axis=1) <= mm_to_m(RADIUS_MM))


def study_groups(mesh: TetMesh) -> dict[str, NDArray[np.intp]]:
    """Name target nodes by where they lie; those on septa are left out, where another mesh may be read from the wrong side."""
    sheets = [mesh.facets[name].ravel() for name in ("falx", "tentorium") if name in mesh.facets]
    on_septa = np.concatenate([np.zeros(0, np.int32), *sheets])
    groups = target_groups(mesh, mm_to_m(CENTER_MM), float(mm_to_m(RADIUS_MM)))
    kept = {name: np.setdiff1d(ids, on_septa) for name, ids in groups.items()}
    return {name: ids for name, ids in kept.items() if len(ids)}

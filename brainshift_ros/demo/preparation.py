"""Before surgery: the template's MR with a tumour, and the patient models made from it."""

from __future__ import annotations

import json
from collections.abc import Callable

from brainshift_ros import __version__
from brainshift_ros.demo.settings import DemoFiles, DemoSettings
from brainshift_ros.files import atomic_path, sha256_of_file
from brainshift_ros.h5 import digest
from brainshift_ros.image.io import write_volume
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.patient_file import read_patient, write_patient
from brainshift_ros.mesh.template_patient import TemplateImages, template_patient_images
from brainshift_ros.resources import resource

Progress = Callable[[str, float], None]

#: The truth's mesh starts from another seed than the patient's.
TRUTH_MESH_SEED = 1


def make_images(settings: DemoSettings, files: DemoFiles) -> TemplateImages:
    """Draw the tumour into the template's T1 and labels, and write both."""
    images = template_patient_images(settings.tumor, settings.septa_spacing_mm)
    write_volume(files.t1, images.t1)
    write_volume(files.labels, images.labels)
    return images


def make_patients(
    settings: DemoSettings, files: DemoFiles, images: TemplateImages, progress: Progress
) -> tuple[PatientModel, PatientModel, bool]:
    """Mesh the patient and the truth, or read them if nothing that decides them has changed since they were made.

    Returns
    -------
    patient, truth_patient, kept
    """
    made_from = _made_from(settings, images)
    if _kept(files, made_from):
        return read_patient(files.patient), read_patient(files.truth_patient), True
    files.made_from.unlink(missing_ok=True)
    t1 = images.t1
    image = ImageReference(files.t1.name, sha256_of_file(files.t1), t1.shape, t1.T_patient_voxel)
    models = []
    for number, (name, path, nodes, seed) in enumerate(
        (
            ("patient", files.patient, settings.nodes, 0),
            ("truth", files.truth_patient, settings.truth_nodes, TRUTH_MESH_SEED),
        )
    ):

        def report(stage: str, fraction: float, name: str = name, number: int = number) -> None:
            progress(f"{name}: {stage}", (number + fraction) / 2.0)

        model = build_patient(t1, images.labels, images.septa, nodes=nodes, image_ref=image, seed=seed, progress=report)
        write_patient(path, model)
        models.append(model)
    with atomic_path(files.made_from) as temporary:
        temporary.write_text(json.dumps(made_from, indent=1), encoding="utf-8")
    return models[0], models[1], False


def _made_from(settings: DemoSettings, images: TemplateImages) -> dict[str, str | float]:
    t1 = images.t1
    return {
        "software": __version__,
        "images": digest(t1.data, t1.T_patient_voxel, images.labels.data),
        "landmarks": sha256_of_file(resource("config/template_mni152.yaml")),
        "nodes": settings.nodes,
        "truth_nodes": settings.truth_nodes,
        "septa_spacing_mm": settings.septa_spacing_mm,
    }


def _kept(files: DemoFiles, made_from: dict[str, str | float]) -> bool:
    if not (files.made_from.is_file() and files.patient.is_file() and files.truth_patient.is_file()):
        return False
    kept: bool = json.loads(files.made_from.read_text(encoding="utf-8")) == made_from
    return kept

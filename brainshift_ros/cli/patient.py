"""`brainshift patient`: T1 MR and labels to a patient model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from brainshift_ros.errors import InputError
from brainshift_ros.files import sha256_of_file, writable_target
from brainshift_ros.image.io import read_volume
from brainshift_ros.image.labels import add_tumor, labels_on_grid
from brainshift_ros.image.landmarks import read_septa_landmarks
from brainshift_ros.image.template import template_labels, template_landmarks, template_t1
from brainshift_ros.image.volume import Volume
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.export import export_mesh
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.patient_file import write_patient
from brainshift_ros.mesh.sheets import Septum, septa_from_landmarks, septa_spacing_mm

_STAGES = ("surfaces", "mesh", "septa", "tissue", "cortex")


@click.command("patient")
@click.argument("t1_path", metavar="T1.nii.gz", type=click.Path(path_type=Path))
@click.option("--labels", "labels_path", type=click.Path(path_type=Path), help="Label image, values 0 to 5, on any grid.")
@click.option("--tumor", "tumor_path", type=click.Path(path_type=Path), help="Tumour mask, on any grid.")
@click.option("--nodes", default=20_000, show_default=True, help="About how many nodes the mesh shall have.")
@click.option("--septa", "septa_choice", default="none", show_default=True, metavar="none|FILE|auto", help="Dural septa.")
@click.option("--seed", default=0, show_default=True, help="Another seed gives another mesh of the same brain.")
@click.option("--export", type=click.Path(path_type=Path), help="Also write the mesh for other software (.vtu, .msh, ...).")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Patient file to write (HDF5).")
def command(
    t1_path: Path,
    labels_path: Path | None,
    tumor_path: Path | None,
    nodes: int,
    septa_choice: str,
    seed: int,
    export: Path | None,
    output: Path,
) -> None:
    """Mesh a brain from its T1 MR and labels, and write a patient file.

    Labels: 0 outside, 1 left cerebrum, 2 right cerebrum, 3 cerebellum, 4 brainstem, 5 tumour. A septa FILE holds the
    landmarks of falx and tentorium in mm (see config/template_mni152.yaml); `auto` takes the template's, for its own T1.
    """
    for target in (output, export):
        if target is not None:
            writable_target(target)
    t1 = read_volume(t1_path)
    labels = _labels(t1, t1_path, labels_path)
    if tumor_path is not None:
        labels = add_tumor(labels, read_volume(tumor_path), tumor_path)
    septa = _septa(septa_choice, t1, t1_path, septa_spacing_mm(nodes))
    image = ImageReference(t1_path.name, sha256_of_file(t1_path), t1.shape, t1.T_patient_voxel)
    console = Console(stderr=True)
    with _progress(console) as report:
        patient = build_patient(t1, labels, septa, image_ref=image, nodes=nodes, seed=seed, progress=report)
    write_patient(output, patient)
    if export is not None:
        export_mesh(export, patient)
    _summarise(console, patient, output)


def _labels(t1: Volume, t1_path: Path, labels_path: Path | None) -> Volume:
    if labels_path is not None:
        return labels_on_grid(read_volume(labels_path), t1, labels_path)
    if _is_template(t1):
        return template_labels(template_landmarks())
    problem = "no label image was given, and labels cannot be made from a T1 automatically in this version"
    raise InputError(t1_path, problem, "give --labels with values 0 to 5, drawn in any segmentation tool")


def _septa(choice: str, t1: Volume, t1_path: Path, spacing_mm: float) -> tuple[Septum, ...]:
    if choice == "none":
        return ()
    if choice != "auto":
        return septa_from_landmarks(read_septa_landmarks(choice), spacing_mm)
    if _is_template(t1):
        return septa_from_landmarks(template_landmarks().septa, spacing_mm)
    problem = "septa cannot be found on a T1 automatically in this version"
    raise InputError(t1_path, problem, "give --septa FILE with landmarks, or --septa none")


def _is_template(t1: Volume) -> bool:
    template = template_t1()
    return (
        t1.shape == template.shape
        and np.allclose(t1.T_patient_voxel, template.T_patient_voxel)
        and np.allclose(t1.data, template.data, atol=1e-3)
    )


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[str, float], None]]:
    columns = (TextColumn("{task.description:9}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        tasks = {stage: progress.add_task(stage, total=1.0, start=False) for stage in _STAGES}

        def report(stage: str, fraction: float) -> None:
            for earlier in _STAGES[: _STAGES.index(stage)]:
                progress.update(tasks[earlier], completed=1.0)
            progress.start_task(tasks[stage])
            progress.update(tasks[stage], completed=fraction)

        yield report


def _summarise(console: Console, patient: PatientModel, output: Path) -> None:
    table = Table("figure", "value", title=f"{output}")
    for name, value in patient.quality.items():
        table.add_row(name, f"{value:.6g}")
    console.print(table)
    for warning in patient.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)

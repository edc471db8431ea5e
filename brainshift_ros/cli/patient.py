"""`brainshift patient`: T1 MR to a patient model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from brainshift_ros.atlas.scene import Craniotomy, read_scene
from brainshift_ros.cli.images import image_reference, read_tumors
from brainshift_ros.cli.progress import stage_bars
from brainshift_ros.files import writable_target
from brainshift_ros.image.io import read_volume
from brainshift_ros.image.labels import add_tumor, labels_on_grid
from brainshift_ros.image.volume import Volume
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.export import export_mesh
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.patient_file import write_patient
from brainshift_ros.pictures.patient_page import patient_page
from brainshift_ros.segmentation.segment import Segmentation, segment
from brainshift_ros.septa.files import read_septa
from brainshift_ros.septa.sheets import Septum, septa_spacing_mm
from brainshift_ros.septa.template import septa_from_template
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]


@click.command("patient")
@click.argument("t1_path", metavar="T1", type=click.Path(path_type=Path))
@click.option("--labels", "labels_path", type=click.Path(path_type=Path), help="Label image, values 0 to 5, on any grid.")
@click.option(
    "--tumor", "tumor_paths", multiple=True, type=click.Path(path_type=Path), help="Tumour mask, on any grid (repeatable)."
)
@click.option("--nodes", default=20_000, show_default=True, help="About how many nodes the mesh shall have.")
@click.option("--septa", "septa_choice", default="auto", show_default=True, metavar="auto|none|FILE", help="Dural septa.")
@click.option("--scene", "scene_path", type=click.Path(path_type=Path), help="Scene whose craniotomy refines the mesh.")
@click.option("--white-above", type=float, help="MR intensity that parts grey from white matter; default: by Otsu's method.")
@click.option("--seed", default=0, show_default=True, help="Another seed gives another mesh of the same brain.")
@click.option("--export", type=click.Path(path_type=Path), help="Also write the mesh for other software (.vtu, .msh, ...).")
@click.option(
    "--page", "page_path", type=click.Path(path_type=Path), help="Picture page; default: the output's name with .png."
)
@click.option("--series", help="Number or unique id of the DICOM series, where a folder holds several.")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Patient file to write (HDF5).")
def command(
    t1_path: Path,
    labels_path: Path | None,
    tumor_paths: tuple[Path, ...],
    nodes: int,
    septa_choice: str,
    scene_path: Path | None,
    white_above: float | None,
    seed: int,
    export: Path | None,
    page_path: Path | None,
    series: str | None,
    output: Path,
) -> None:
    """Make a patient model of a T1 MR: a NIfTI file, or a folder with one DICOM series; whole head or stripped.

    Labels: 0 outside, 1 left cerebrum, 2 right cerebrum, 3 cerebellum, 4 brainstem, 5 tumour. Without --labels, and with
    --septa auto, the template is registered to the T1. A septa FILE holds a person's landmarks of falx and tentorium (see
    config/septa_example.yaml) or sheets from `brainshift segment --septa`.
    """
    page_path = page_path or output.with_suffix(".png")
    for target in (output, export, page_path):
        if target is not None:
            writable_target(target)
    t1 = read_volume(t1_path, series)
    tumor = read_tumors(tumor_paths, t1)
    given = None if labels_path is None else labels_on_grid(read_volume(labels_path), t1, labels_path)
    craniotomy = None if scene_path is None else _opening(read_scene(scene_path).craniotomy)
    console = Console(stderr=True)
    with stage_bars(console) as report:
        found = segment(t1, tumor=tumor, progress=report) if given is None or septa_choice == "auto" else None
        labels = _labels(given, tumor, found)
        patient = build_patient(
            t1,
            labels,
            _septa(septa_choice, found, septa_spacing_mm(nodes), labels),
            image_ref=image_reference(t1, t1_path),
            nodes=nodes,
            seed=seed,
            craniotomy=craniotomy,
            tissue_threshold=white_above,
            progress=report,
        )
        if found is not None:
            patient = replace(patient, warnings=(*found.warnings, *patient.warnings), template_map=found.template_map)
        write_patient(output, patient)
        report("page", 0.0)
        patient_page(patient, t1, labels, page_path)
    if export is not None:
        export_mesh(export, patient)
    _summarise(console, patient, output, page_path)


def _opening(craniotomy: Craniotomy | None) -> tuple[np.ndarray, float] | None:
    """Centre and radius in metres."""
    if craniotomy is None:
        return None
    return mm_to_m(np.array(craniotomy.center_mm)), float(mm_to_m(craniotomy.diameter_mm)) / 2.0


def _labels(given: Volume | None, tumor: Volume | None, found: Segmentation | None) -> Volume:
    if given is None:
        assert found is not None, "without labels the template is registered"
        return found.labels
    return given if tumor is None else add_tumor(given, tumor)


def _septa(choice: str, found: Segmentation | None, spacing_mm: float, labels: Volume) -> tuple[Septum, ...]:
    if choice == "none":
        return ()
    if choice == "auto":
        assert found is not None, "for automatic septa the template is registered"
        return septa_from_template(found.template_map.to_patient, spacing_mm)
    return read_septa(choice, spacing_mm, labels)


def _summarise(console: Console, patient: PatientModel, output: Path, page: Path) -> None:
    table = Table("figure", "value", title=f"{output}, {page}")
    for name, value in patient.quality.items():
        table.add_row(name, f"{value:.6g}")
    console.print(table)
    for warning in patient.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)

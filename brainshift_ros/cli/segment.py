"""`brainshift segment`: labels and dural septa of a T1 MR, from the template by registration."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from brainshift_ros.cli.images import read_tumors
from brainshift_ros.cli.progress import stage_bars
from brainshift_ros.files import writable_target
from brainshift_ros.image.io import NIFTI_SUFFIXES, read_volume, write_volume
from brainshift_ros.segmentation.segment import Segmentation, segment
from brainshift_ros.septa.files import MESH_SUFFIXES, write_septa
from brainshift_ros.septa.sheets import septa_spacing_mm
from brainshift_ros.septa.template import septa_from_template


@click.command("segment")
@click.argument("t1_path", metavar="T1", type=click.Path(path_type=Path))
@click.option(
    "--tumor", "tumor_paths", multiple=True, type=click.Path(path_type=Path), help="Tumour mask, on any grid (repeatable)."
)
@click.option("--septa", "septa_path", type=click.Path(path_type=Path), help="Also write the septa, as sheets (.vtu).")
@click.option("--series", help="Number or unique id of the DICOM series, where a folder holds several.")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Label image to write (.nii.gz).")
def command(t1_path: Path, tumor_paths: tuple[Path, ...], septa_path: Path | None, series: str | None, output: Path) -> None:
    """Label brain, cerebellum and brainstem of a T1 MR (NIfTI or DICOM folder), whole head or stripped.

    Look at the labels, correct them in any editor, and give them to `brainshift patient --labels`.
    """
    writable_target(output, NIFTI_SUFFIXES)
    if septa_path is not None:
        writable_target(septa_path, MESH_SUFFIXES)
    t1 = read_volume(t1_path, series)
    console = Console(stderr=True)
    with stage_bars(console) as report:
        found = segment(t1, tumor=read_tumors(tumor_paths, t1), progress=report)
    write_volume(output, found.labels)
    if septa_path is not None:
        write_septa(septa_path, septa_from_template(found.template_map.to_patient, septa_spacing_mm(20_000)))
    report_segmentation(found, console)


def report_segmentation(found: Segmentation, console: Console) -> None:
    """Print what a person should know of a segmentation."""
    figures = ", ".join(f"{name} {value:.3g}" for name, value in found.diagnostics.items())
    console.print(f"segmentation: {figures}", soft_wrap=True, highlight=False)
    for warning in found.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)

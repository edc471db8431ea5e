"""`brainshift compare`: an automatic segmentation against a person's (spec P2)."""

from __future__ import annotations

import json
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from brainshift_ros.evaluation.report import SegmentationReport, compare_segmentations
from brainshift_ros.files import atomic_path, writable_target
from brainshift_ros.image.io import read_volume
from brainshift_ros.image.labels import labels_on_grid
from brainshift_ros.septa.files import read_septa
from brainshift_ros.septa.sheets import septa_spacing_mm


@click.command("compare")
@click.argument("automatic_path", metavar="AUTOMATIC.nii.gz", type=click.Path(path_type=Path))
@click.argument("manual_path", metavar="MANUAL.nii.gz", type=click.Path(path_type=Path))
@click.option(
    "--septa",
    "septa_paths",
    nargs=2,
    type=click.Path(path_type=Path),
    metavar="AUTOMATIC MANUAL",
    help="Septa files of both (.vtu of `brainshift segment`, or landmarks in YAML).",
)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Also write all figures (JSON).")
def command(automatic_path: Path, manual_path: Path, septa_paths: tuple[Path, Path] | None, output: Path | None) -> None:
    """Compare two segmentations: Dice and distances by region, slices that need editing, distances of falx and tentoria."""
    if output is not None:
        writable_target(output)
    manual = read_volume(manual_path)
    manual = labels_on_grid(manual, manual, manual_path)
    automatic = labels_on_grid(read_volume(automatic_path), manual, automatic_path)
    septa = [read_septa(path, septa_spacing_mm(20_000)) for path in septa_paths or ()]
    report = compare_segmentations(automatic, manual, *septa)
    if output is not None:
        with atomic_path(output) as temporary:
            temporary.write_text(json.dumps(report.to_json(), indent=1), encoding="utf-8")
    _print(report, Console())


def _print(report: SegmentationReport, console: Console) -> None:
    regions = Table("region", "Dice", "automatic, ml", "manual, ml", "surface distance, mm", "95 %, mm")
    for name, agreement in report.regions.items():
        surface = (
            ("-", "-") if agreement.surface is None else (f"{agreement.surface.mean_mm:.2f}", f"{agreement.surface.p95_mm:.2f}")
        )
        regions.add_row(name, f"{agreement.dice:.3f}", f"{agreement.automatic_ml:.1f}", f"{agreement.manual_ml:.1f}", *surface)
    console.print(regions)
    slices = report.slices
    wrong = f"{len(slices.with_errors)} of {slices.slices} {slices.orientation} slices"
    console.print(f"{wrong} with errors of {slices.visible_mm:g} mm or more")
    if report.septa:
        septa = Table("septum", "mean, mm", "std, mm", "max, mm")
        for name, distance in report.septa.items():
            found = distance.to_manual
            septa.add_row(
                name, *(("-",) * 3 if found is None else (f"{v:.2f}" for v in (found.mean_mm, found.std_mm, found.max_mm)))
            )
        console.print(septa)
    for warning in report.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)

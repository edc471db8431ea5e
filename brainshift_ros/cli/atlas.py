"""`brainshift atlas`: scene and patient to atlas, or a description of an atlas."""

from __future__ import annotations

import sys
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from brainshift_ros.atlas.build import BuildReport, build_atlas
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.scene import read_scene
from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.materials import TABLE_1
from brainshift_ros.mechanics.materials_file import read_materials
from brainshift_ros.mechanics.solvers import SolverName
from brainshift_ros.mesh.patient_file import read_patient
from brainshift_ros.units import m_to_mm


@click.command()
@click.argument("scene_path", metavar="[SCENE.yaml]", required=False, type=click.Path(path_type=Path))
@click.option("--patient", "patient_path", type=click.Path(path_type=Path), help="Patient file, from `brainshift patient`.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Atlas file to write (HDF5).")
@click.option("--materials", "materials_path", type=click.Path(path_type=Path), help="Tissue properties; default: table 1.")
@click.option(
    "--solver",
    type=click.Choice(["auto", "pardiso", "scipy"]),
    default="auto",
    show_default=True,
    help="Linear solver; auto is PARDISO where MKL can be loaded, else SciPy, which is slow.",
)
@click.option("--show", "shown", metavar="ATLAS", type=click.Path(path_type=Path), help="Describe an atlas and stop.")
def command(
    scene_path: Path | None,
    patient_path: Path | None,
    output: Path | None,
    materials_path: Path | None,
    solver: SolverName,
    shown: Path | None,
) -> None:
    """Solve what SCENE.yaml names on a patient's mesh and write the atlas.

    A build that is stopped (Ctrl-C) leaves no file behind, and an atlas that was there before stays as it was.
    """
    console = Console()
    if shown is not None:
        _show(shown, console)
        return
    if scene_path is None or patient_path is None or output is None:
        raise click.UsageError("give SCENE.yaml, --patient and -o; or --show with an atlas")
    scene, patient = read_scene(scene_path), read_patient(patient_path)
    materials = TABLE_1 if materials_path is None else read_materials(materials_path)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn())
    try:
        with Progress(*columns, console=console) as progress:
            task = progress.add_task("read", total=1.0)
            report = build_atlas(
                patient,
                scene,
                output,
                materials=materials,
                solver=solver,
                progress=lambda stage, fraction: progress.update(task, description=stage, completed=fraction),
            )
    except KeyboardInterrupt:
        console.print("brainshift atlas: stopped; nothing was written", style="red")
        sys.exit(130)
    except ArithmeticError as error:
        remedy = "look at the mesh's quality in the patient file, and make the patient again"
        raise InputError(patient_path, f"its mesh cannot be solved ({error})", remedy) from error
    except InputError as error:
        # The builder knows the scene as "scene"; name the file.
        raise (InputError(scene_path, error.problem, error.remedy) if error.source == "scene" else error) from error
    _print_report(report, console)


def _print_report(report: BuildReport, console: Console) -> None:
    shift_mm = m_to_mm(report.largest_shift)
    times = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in report.times_s.items())
    console.print(
        f"{report.path}: {report.entries} entries by {report.solver}, residual {report.residual:.1e} ({times})", soft_wrap=True
    )
    console.print(f"largest shift of an entry {shift_mm.min():.1f} to {shift_mm.max():.1f} mm")
    if report.craniotomy_shift is not None:
        opening_mm = m_to_mm(report.craniotomy_shift)
        console.print(f"under the craniotomy {opening_mm.min():.1f} to {opening_mm.max():.1f} mm")
    for warning in report.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)


def _show(path: Path, console: Console) -> None:
    with open_atlas(path) as atlas:
        info = atlas.info()
        levels = sorted({entry.fluid_level for entry in atlas.entries})
        states = sorted({"resected" if entry.resected else "with tumour" for entry in atlas.entries}, reverse=True)
        directions = {entry.gravity_direction for entry in atlas.entries}
    table = Table(show_header=False, title=str(path))
    for key in ("atlas_id", "patient_id", "nodes", "elements", "entries", "software", "created"):
        table.add_row(key, str(info[key]))
    table.add_row("mechanisms", ", ".join(info["mechanisms"]))
    table.add_row("orientations", str(len(directions)))
    table.add_row("fluid levels", ", ".join(f"{level:.2f}" for level in levels))
    table.add_row("resection", ", ".join(states))
    table.add_row("septa", "yes" if info["scene"]["septa"] else "no")
    console.print(table)

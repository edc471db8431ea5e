"""`brainshift atlas`: scene and patient to atlas, or a description of an atlas."""

from __future__ import annotations

import sys
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from brainshift_ros.atlas.build import BuildReport, build_atlas
from brainshift_ros.atlas.building import building_path
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.scene import Scene, read_scene
from brainshift_ros.cli.atlas_table import atlas_table
from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path, writable_target
from brainshift_ros.mechanics.materials import TABLE_1
from brainshift_ros.mechanics.materials_file import read_materials
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.patient_file import read_patient
from brainshift_ros.pictures.conditions import conditions_page
from brainshift_ros.solvers.direct import SolverName
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
@click.option(
    "--scheduler", metavar="ADDRESS", help="Solve on the workers of this dask scheduler (tcp://host:8786), not in this process."
)
@click.option("--fresh", is_flag=True, help="Start anew, whatever an interrupted build has left.")
@click.option("--page", "page_path", type=click.Path(path_type=Path), help="Also draw the boundary conditions (PNG).")
@click.option("--show", "shown", metavar="ATLAS", type=click.Path(path_type=Path), help="Describe an atlas and stop.")
def command(
    scene_path: Path | None,
    patient_path: Path | None,
    output: Path | None,
    materials_path: Path | None,
    solver: SolverName,
    scheduler: str | None,
    fresh: bool,
    page_path: Path | None,
    shown: Path | None,
) -> None:
    """Solve what SCENE.yaml names on a patient's mesh and write the atlas.

    A build that is stopped, by Ctrl-C or by the machine, writes no atlas, and one that was there before stays as it was. What
    it solved is kept in a hidden folder beside the output: the same command resumes there.
    """
    console = Console()
    if shown is not None:
        with open_atlas(shown) as atlas:
            console.print(atlas_table(atlas))
        return
    if scene_path is None or patient_path is None or output is None:
        raise click.UsageError("give SCENE.yaml, --patient and -o; or --show with an atlas")
    scene, patient = read_scene(scene_path), read_patient(patient_path)
    materials = TABLE_1 if materials_path is None else read_materials(materials_path)
    if page_path is not None:
        # Before the build: a wrong direction or craniotomy is best seen before it is solved.
        _draw_conditions(patient, scene, page_path)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    try:
        with Progress(*columns, console=console) as progress:
            task = progress.add_task("read", total=1.0)
            report = build_atlas(
                patient,
                scene,
                output,
                materials=materials,
                solver=solver,
                scheduler=scheduler,
                fresh=fresh,
                progress=lambda stage, fraction: progress.update(task, description=stage, completed=fraction),
            )
    except KeyboardInterrupt:
        kept = building_path(output).exists()
        rest = "what was solved is kept, and the same command resumes there" if kept else "nothing was written"
        console.print(f"brainshift atlas: stopped; {rest}", style="red", soft_wrap=True)
        sys.exit(130)
    except ArithmeticError as error:
        remedy = "look at the mesh's quality in the patient file, and make the patient again"
        raise InputError(patient_path, f"its mesh cannot be solved ({error})", remedy) from error
    except InputError as error:
        # The builder knows neither file by its path.
        path = {"scene": scene_path, "patient": patient_path}.get(error.source)
        raise (error if path is None else InputError(path, error.problem, error.remedy)) from error
    _print_report(report, console)


def _draw_conditions(patient: PatientModel, scene: Scene, path: Path) -> None:
    writable_target(path)
    figure = conditions_page(patient, scene)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=90)


def _print_report(report: BuildReport, console: Console) -> None:
    shift_mm = m_to_mm(report.largest_shift)
    times = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in report.times_s.items())
    kept = f", {report.resumed} of them kept from an interrupted build" if report.resumed else ""
    console.print(
        f"{report.path}: {report.entries} entries by {report.solver}{kept}, "
        f"residual {report.residual:.1e}, {report.wall_s:.1f} s ({times})",
        soft_wrap=True,
    )
    console.print(f"largest shift of an entry {shift_mm.min():.1f} to {shift_mm.max():.1f} mm")
    if report.craniotomy_shift is not None:
        opening_mm = m_to_mm(report.craniotomy_shift)
        console.print(f"under the craniotomy {opening_mm.min():.1f} to {opening_mm.max():.1f} mm")
    for warning in report.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)

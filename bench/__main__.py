"""`python -m bench`: run every benchmark on the demo's patient, write JSON, print tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from bench import atlas, fields, inverse, scans
from bench.images import SIZE as IMAGE_SIZE
from bench.images import run as run_images
from bench.peers import slip
from brainshift_ros.atlas.columns import entries_of
from brainshift_ros.atlas.scene import read_scene
from brainshift_ros.demo.preparation import make_images, make_patients
from brainshift_ros.demo.settings import DemoFiles, DemoSettings
from brainshift_ros.files import atomic_path
from brainshift_ros.mechanics.skull import SkullName
from brainshift_ros.resources import resource
from brainshift_ros.solvers.direct import SolverName

#: Both models of the skull are compared with refactoring.
SKULL_MODELS: tuple[SkullName, ...] = ("free_cap", "contact")


def show(console: Console, title: str, rows: list[dict[str, Any]]) -> None:
    """Print a column a row, under the row's first value: a few candidates, many figures of each."""
    heading, *names = rows[0]
    table = Table(heading, *(str(row[heading]) for row in rows), title=title)
    for name in names:
        table.add_row(name, *(f"{row[name]:.3g}" if isinstance(row[name], float) else str(row[name]) for row in rows))
    console.print(table)


@click.command()
@click.option("--output", type=click.Path(path_type=Path), default=Path("out/bench"), show_default=True)
@click.option("--solver", type=click.Choice(["auto", "pardiso", "scipy"]), default="auto", show_default=True)
def main(output: Path, solver: SolverName) -> None:
    """Measure speed beside accuracy on the demo's patient (made in out/demo if it is not there)."""
    console = Console()
    output.mkdir(parents=True, exist_ok=True)
    files = DemoFiles(Path("out/demo"))
    files.folder.mkdir(parents=True, exist_ok=True)
    settings = DemoSettings()
    with console.status("patient"):
        images = make_images(settings, files)
        patient, _, _ = make_patients(settings, files, images, lambda _stage, _fraction: None)
    full, demo = resource("config/scene_full.yaml"), resource("config/scene_demo.yaml")
    scene = read_scene(full)
    results: dict[str, list[dict[str, Any]]] = {}
    with console.status(f"atlas of {len(entries_of(scene))} entries"):
        small = atlas.build("30 orientations, one level", files.patient, demo, output / "atlas_demo.h5")
        results["atlas"] = [atlas.build("whole atlas", files.patient, full, output / "atlas.h5"), small]
    show(console, f"the whole atlas of {len(patient.mesh.nodes)} nodes", results["atlas"])
    with console.status("file"):
        results["file"] = atlas.read(output / "atlas.h5")
    show(console, "reading it", results["file"])
    with console.status("one factorisation a boundary-condition set"):
        results["refactoring"] = [
            row for skull in SKULL_MODELS for row in atlas.against_refactoring(patient, scene, skull, solver)
        ]
    show(
        console,
        "one factorisation a boundary-condition set, and how far the atlas's solution is from it",
        results["refactoring"],
    )
    with console.status("NGSolve"):
        results["ngsolve"] = atlas.against_ngsolve(patient, scene)
    show(console, "one boundary-condition set by NGSolve", results["ngsolve"])
    with console.status("NGSolve, slip problem"):
        results["ngsolve_slip"] = [slip.compare(order) for order in (1, 2)]
    show(console, "the whole chain by NGSolve: a bar with slip walls", results["ngsolve_slip"])
    with console.status("inverse"):
        results["inverse"] = inverse.run(output / "atlas_demo.h5", patient)
    title = f"inverse from {inverse.POINTS} points, noise {1e3 * inverse.NOISE_M} mm; truth on the atlas's own mesh"
    show(console, title, results["inverse"])
    with console.status("from points to weights"):
        results["points_to_weights"] = inverse.points_to_weights(output / "atlas.h5")
    show(console, "from points to weights, atlas of full size", results["points_to_weights"])
    with console.status("fields"):
        results |= fields.run(output / "atlas.h5")
    show(
        console,
        f"from points to the displacement field in process, by stage: medians of {fields.RUNS}",
        results["field_stages"],
    )
    show(console, f"the same through the node inverse: medians of {fields.RUNS}", results["field_latency"])
    with console.status("images"):
        results |= run_images(patient, scene)
    show(console, f"warping {IMAGE_SIZE}^3 voxels, the brain's shift and the image in memory", results["warp"])
    show(console, "what the transform file loses between its voxels", results["transform"])
    with console.status("scans"):
        results |= scans.run(output, patient)
    show(console, f"a first and a second scan in process, by stage: medians of {scans.RUNS}", results["scan_stages"])
    show(console, f"the same through the node lrs: medians of {scans.RUNS}", results["scan_latency"])
    with atomic_path(output / "bench.json") as temporary:
        temporary.write_text(json.dumps(results, indent=1), encoding="utf-8")
    console.print(f"written: {output / 'bench.json'}")


if __name__ == "__main__":
    main()

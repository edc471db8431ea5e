"""`python -m bench`: run every benchmark on the demo's patient, write JSON, print tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from bench import atlas, inverse
from brainshift_ros.atlas.scene import read_scene
from brainshift_ros.demo.preparation import make_images, make_patients
from brainshift_ros.demo.settings import DemoFiles, DemoSettings
from brainshift_ros.files import atomic_path
from brainshift_ros.mechanics.solvers import resolve
from brainshift_ros.resources import resource


def show(console: Console, title: str, rows: list[dict[str, Any]]) -> None:
    """Print a column a row, under the row's first value: a few candidates, many figures of each."""
    heading, *names = rows[0]
    table = Table(heading, *(str(row[heading]) for row in rows), title=title)
    for name in names:
        table.add_row(name, *(f"{row[name]:.3g}" if isinstance(row[name], float) else str(row[name]) for row in rows))
    console.print(table)


@click.command()
@click.option("--output", type=click.Path(path_type=Path), default=Path("out/bench"), show_default=True)
@click.option("--scipy", "with_scipy", is_flag=True, help="also build with SciPy's own solver (slow)")
def main(output: Path, with_scipy: bool) -> None:
    """Measure speed beside accuracy on the demo's patient (made in out/demo if it is not there)."""
    console = Console()
    output.mkdir(parents=True, exist_ok=True)
    files = DemoFiles(Path("out/demo"))
    files.folder.mkdir(parents=True, exist_ok=True)
    settings = DemoSettings()
    with console.status("patient"):
        images = make_images(settings, files)
        patient, _, _ = make_patients(settings, files, images, lambda _stage, _fraction: None)
    scene = read_scene(resource("config/scene_demo.yaml"))
    fastest = resolve("auto")
    solvers = (fastest, "scipy") if with_scipy and fastest != "scipy" else (fastest,)
    results: dict[str, list[dict[str, Any]]] = {}
    with console.status("atlas"):
        results["atlas"] = atlas.run(scene, patient, output, solvers)
    show(console, f"atlas of {len(patient.mesh.nodes)} nodes", results["atlas"])
    with console.status("inverse"):
        results["inverse"] = inverse.run(output / f"atlas_{fastest}.h5", patient)
    title = f"inverse from {inverse.POINTS} points, noise {1e3 * inverse.NOISE_M} mm; truth on the atlas's own mesh"
    show(console, title, results["inverse"])
    with atomic_path(output / "bench.json") as temporary:
        temporary.write_text(json.dumps(results, indent=1), encoding="utf-8")
    console.print(f"written: {output / 'bench.json'}")


if __name__ == "__main__":
    main()

"""`brainshift demo`: the whole job once, on a real brain."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table


@click.command()
@click.option(
    "--output", type=click.Path(path_type=Path), default=Path("out/demo"), show_default=True, help="folder of results"
)
@click.option("--scene", "scene_file", type=click.Path(path_type=Path), help="another scene (YAML) than the demo's own")
def command(output: Path, scene_file: Path | None) -> None:
    """Take the MNI152 brain through the whole system: mesh, atlas, recorded scans, the four ROS 2 nodes, field, pictures."""
    from brainshift_ros.atlas.scene import read_scene
    from brainshift_ros.demo.run import run_demo
    from brainshift_ros.demo.settings import DemoSettings
    from brainshift_ros.resources import resource

    scene = read_scene(scene_file or resource("config/scene_demo.yaml"))
    console = Console()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%"), TimeElapsedColumn())
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def progress(text: str, fraction: float) -> None:
            stage = text.split(":")[0]
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=1.0)
            finished = fraction >= 1.0 and text == stage
            bars.update(tasks[stage], completed=1.0 if finished else min(fraction, 0.999), description=text)
            if finished:
                bars.update(tasks[stage], description=stage)
                bars.stop_task(tasks[stage])

        summary = run_demo(scene, DemoSettings(), output, progress)
    table = Table("", "value")
    for key in (
        "shift_mm_mean",
        "correction_surface_percent",
        "correction_subsurface_percent",
        "registration_tre_mm",
        "homologous_points",
        "atlas_entries",
        "nonzero_weights",
        "field_valid",
    ):
        value = summary[key]
        table.add_row(key, f"{value:.2f}" if isinstance(value, float) else str(value))
    table.add_row("scan_to_field, s", f"{summary['times_s']['scan_to_field']:.2f}")
    table.add_row("total, s", f"{summary['times_s']['total']:.0f}")
    console.print(table)
    console.print(f"Pictures, files and summary.json: {output}", soft_wrap=True)

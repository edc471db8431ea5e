"""`brainshift experiment`: a study of accuracy, speed or stability, with its figures and pictures."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import click
from rich.console import Console

from brainshift_ros.cli.progress import stage_bars

#: Name -> module with `run(folder, full, progress)`, and the question that it answers.
EXPERIMENTS: dict[str, tuple[str, str]] = {
    "segmentation": ("brainshift_ros.experiments.segmentation", "How far is automatic segmentation from the truth?"),
    "registration": ("brainshift_ros.experiments.registration", "What does registration accuracy cost in time? (E7)"),
    "meshing": ("brainshift_ros.experiments.meshing", "What does mesh size cost in time and memory? (E7)"),
    "scaling": ("brainshift_ros.experiments.scaling", "What does an atlas of 720 entries cost, over mesh size? (E7)"),
    "elements": ("brainshift_ros.experiments.elements", "Linear or quadratic elements, at which mesh size? (E7)"),
    "skull": ("brainshift_ros.experiments.skull", "Free cap or contact: which atlas is closer to finite strain?"),
    "septa-gap": ("brainshift_ros.experiments.septa_gap", "What does a gap between septa and skull do to the field?"),
    "consolidation": ("brainshift_ros.experiments.consolidation", "Does consolidation follow its series and stay smooth? (E8)"),
    "mannitol": ("brainshift_ros.experiments.mannitol", "How nearly is a steady field that of a time in surgery? (E7)"),
    "scans": ("brainshift_ros.experiments.scans", "How accurate are registration and homologous points? (I2, I3)"),
    "scan-limits": ("brainshift_ros.experiments.scan_limits", "Where do scans fail, and is it said? (E8)"),
    "basin": ("brainshift_ros.experiments.basin", "From how far off does the registration of a scan find its place? (I2)"),
    "scan-texture": ("brainshift_ros.experiments.scan_texture", "Would texture hold a scan better than its shape does? (I2)"),
    "vessels": ("brainshift_ros.experiments.vessels", "Which vessels are found, by which filter, at what cost? (E7)"),
    "dense-field": ("brainshift_ros.experiments.dense_field", "Is a dense field worth more than its points? (E6)"),
    "inverse-methods": ("brainshift_ros.experiments.inverse_methods", "Which inverse method holds far from its points? (I5)"),
    "scan-resolution": ("brainshift_ros.experiments.scan_resolution", "What do finer scans bring, and cost in time? (E7)"),
    "solvers": ("brainshift_ros.experiments.solvers", "Which solver finds the weights exactly, in what time? (E7)"),
    "atlas-extent": ("brainshift_ros.experiments.atlas_extent", "How far may the head lie from where it was planned? (E3)"),
    "atlas-size": ("brainshift_ros.experiments.atlas_size", "How many head orientations does an atlas need? (E3)"),
    "atlas-levels": ("brainshift_ros.experiments.atlas_levels", "Does an atlas need levels of fluid and drug? (E3)"),
    "atlas-content": ("brainshift_ros.experiments.atlas_content", "What does an atlas hold, and an estimate use of it? (E3)"),
    "uncertainty": ("brainshift_ros.experiments.uncertainty", "Does the stated standard deviation hold up? (I5)"),
    "outliers": ("brainshift_ros.experiments.outliers", "How many wrong points does an estimate bear? (E6, E8)"),
}


@click.command("experiment", epilog=" ".join(f"{name}: {question}" for name, (_, question) in EXPERIMENTS.items()))
@click.argument("name", type=click.Choice(sorted(EXPERIMENTS)))
@click.option("--full", is_flag=True, help="The whole study, which takes long; without it a short one.")
@click.option("--output", type=click.Path(path_type=Path), default=Path("out/experiments"), show_default=True)
def command(name: str, full: bool, output: Path) -> None:
    """Run a study; write summary.json, CSV and PNG to OUTPUT/NAME."""
    folder = output / name
    folder.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    with stage_bars(console) as report:
        import_module(EXPERIMENTS[name][0]).run(folder, full, report)
    console.print(f"written: {folder}/summary.json and what lies beside it")

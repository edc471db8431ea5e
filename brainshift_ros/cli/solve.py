"""`brainshift solve`: atlas and sparse points to displacement field."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import click

from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.field.field_file import write_field
from brainshift_ros.files import atomic_path, writable_target
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.methods import METHODS
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.points_csv import read_homologous_points

#: Exit status when the field was written but is not valid.
NOT_VALID = 3


@click.command()
@click.argument("atlas", type=click.Path(path_type=Path))
@click.argument("points", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="Field file to write (HDF5).")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Also write the whole estimate as JSON.")
@click.option("--method", type=click.Choice(list(METHODS)), default="constrained", show_default=True)
@click.option("--max-outside-mm", type=click.FloatRange(0.0, 50.0), default=5.0, show_default=True,
              help="Points farther outside the brain are dropped.")  # fmt: skip
def command(atlas: Path, points: Path, output: Path, json_path: Path | None, method: str, max_outside_mm: float) -> None:
    """Estimate the shift from ATLAS and POINTS, a CSV in mm, RAS: x y z dx dy dz [sigma].

    Ends with status 3 if the estimate is not valid; the field is written all the same, marked as not valid.
    """
    for target in filter(None, (output, json_path)):
        writable_target(target)
    measured = read_homologous_points(points)
    options = replace(InverseOptions(), method=method, max_outside_mm=max_outside_mm)
    with open_atlas(atlas) as opened:
        estimate = estimate_shift(opened, measured, options=options)
    write_field(output, estimate.field)
    if json_path is not None:
        with atomic_path(json_path) as temporary:
            temporary.write_text(json.dumps(estimate.to_json(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    click.echo(estimate.summary())
    for warning in estimate.warnings:
        click.echo(f"note: {warning}")
    click.echo(f"wrote {output}")
    if not estimate.valid:
        click.get_current_context().exit(NOT_VALID)

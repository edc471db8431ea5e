"""`brainshift solve`: atlas and sparse points to displacement field."""

from __future__ import annotations

import json
import math
from pathlib import Path

import click

from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.field.field_file import write_field
from brainshift_ros.files import atomic_path, writable_target
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.methods import METHODS
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.points_csv import read_homologous_points

DEFAULT = InverseOptions()

#: Exit status when the field was written but is not valid.
NOT_VALID = 3


def _number(_context: click.Context, _option: click.Parameter, value: float) -> float:
    """Refuse NaN, which passes every range."""
    if math.isnan(value):
        raise click.BadParameter("nan is not a number")
    return value


@click.command()
@click.argument("atlas", type=click.Path(path_type=Path))
@click.argument("points", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="Field file to write (HDF5).")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Also write the whole estimate as JSON.")
@click.option("--picture", type=click.Path(path_type=Path), help="Also draw it: vectors, weights, residuals (PNG).")
@click.option(
    "--method",
    type=click.Choice(list(METHODS)),
    default=DEFAULT.method,
    show_default=True,
    help="How the weights are found; constrained, nnls, osqp and clarabel solve the same problem (3.9).",
)
@click.option(
    "--max-outside-mm",
    type=click.FloatRange(0.0, 50.0),
    default=DEFAULT.max_outside_mm,
    show_default=True,
    callback=_number,
    help="Points farther outside the brain are dropped.",
)
@click.option(
    "--outlier-sigmas",
    type=click.FloatRange(2.0, 100.0),
    default=DEFAULT.outlier_sigmas,
    show_default=True,
    callback=_number,
    help="A point with a larger residual, in robust sigmas, is dropped.",
)
def command(
    atlas: Path,
    points: Path,
    output: Path,
    json_path: Path | None,
    picture: Path | None,
    method: str,
    max_outside_mm: float,
    outlier_sigmas: float,
) -> None:
    """Estimate the shift from ATLAS and POINTS, a CSV in mm, RAS: x y z dx dy dz [sigma].

    Ends with status 3 if the estimate is not valid; the field is written all the same, marked as not valid.
    """
    for target, suffixes in ((output, ()), (json_path, ()), (picture, (".png",))):
        if target is not None:
            writable_target(target, suffixes)
    measured = read_homologous_points(points)
    options = InverseOptions(method=method, max_outside_mm=max_outside_mm, outlier_sigmas=outlier_sigmas)
    with open_atlas(atlas) as opened:
        estimate = estimate_shift(opened, measured, options=options)
    write_field(output, estimate.field)
    written = [output]
    if json_path is not None:
        with atomic_path(json_path) as temporary:
            temporary.write_text(json.dumps(estimate.to_json(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
        written.append(json_path)
    if picture is not None:
        # Only here: matplotlib takes longer to import than the estimate to compute.
        from brainshift_ros.pictures.estimate import estimate_page

        estimate_page(picture, estimate)
        written.append(picture)
    click.echo(estimate.summary())
    for warning in estimate.warnings:
        click.echo(f"note: {warning}")
    click.echo(f"wrote {', '.join(map(str, written))}")
    if not estimate.valid:
        click.get_current_context().exit(NOT_VALID)

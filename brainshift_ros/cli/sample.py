"""`brainshift sample`: displacement and standard deviation at any points."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.field_file import read_field
from brainshift_ros.files import writable_target
from brainshift_ros.inverse.points_csv import DISPLACEMENT_COLUMNS, POINT_COLUMNS, read_points, write_table
from brainshift_ros.units import m_to_mm, mm_to_m

#: Points this near to the surface belong to the brain: cortex points carry the noise of a scan, and of rounding.
ON_SURFACE_MM = 1.0


@click.command()
@click.argument("field", type=click.Path(path_type=Path))
@click.argument("points", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="CSV to write.")
def command(field: Path, points: Path, output: Path) -> None:
    """Sample FIELD at POINTS, a CSV of x y z in mm, RAS, before the shift.

    Writes x y z dx dy dz std inside, in mm. Points within 1 mm of the brain count as inside. Farther out (inside = 0) the
    displacement is that of the smooth surroundings which warped images use, and std is nan: nothing is known of it.
    """
    writable_target(output)
    shift = read_field(field)
    positions = read_points(points)
    deformation = Deformation(shift)
    located = deformation.locator.locate(positions, max_outside_m=float(mm_to_m(ON_SURFACE_MM)))
    displacement = deformation.forward_at(positions)
    displacement[located.found] = located.interpolate(shift.mesh, shift.displacement)[located.found]
    std = located.interpolate(shift.mesh, shift.std)
    numbers = np.column_stack([m_to_mm(positions), m_to_mm(displacement), m_to_mm(std)]).tolist()
    rows = [[*row, int(inside)] for row, inside in zip(numbers, located.found, strict=True)]
    write_table(output, (*POINT_COLUMNS, *DISPLACEMENT_COLUMNS, "std", "inside"), rows)
    click.echo(f"{int(located.found.sum())} of {len(rows)} points lie in the brain; wrote {output}")

"""`brainshift warp`: displacement field and image to warped image, and an ITK transform."""

from __future__ import annotations

from pathlib import Path

import click

from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.field_file import read_field
from brainshift_ros.field.warp import warp_image
from brainshift_ros.files import writable_target
from brainshift_ros.image.io import NIFTI_SUFFIXES, read_volume, write_volume
from brainshift_ros.image.itk import write_displacement_image
from brainshift_ros.units import m_to_mm


@click.command()
@click.argument("field", type=click.Path(path_type=Path))
@click.argument("image", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="Warped image to write (NIfTI).")
@click.option("--transform", type=click.Path(path_type=Path), help="Also write the displacement transform (NIfTI, for ITK).")
@click.option("--labels", is_flag=True, help="IMAGE holds labels: nearest neighbour, no new values.")
def command(field: Path, image: Path, output: Path, transform: Path | None, labels: bool) -> None:
    """Bring a preoperative IMAGE to where FIELD says the brain is now, on the image's own grid.

    The transform is a NIfTI vector image in LPS mm that ITK, SimpleITK, ANTs and 3D Slicer read: it takes each point of
    the updated image to where it was before surgery, as resampling needs.
    """
    for target in filter(None, (output, transform)):
        writable_target(target, NIFTI_SUFFIXES)
    shift = read_field(field)
    volume = read_volume(image)
    deformation = Deformation(shift)
    warped = warp_image(deformation, volume, interpolation="nearest" if labels else "linear")
    write_volume(output, warped.volume)
    if transform is not None:
        write_displacement_image(transform, warped.inverse, warped.grid)
    notes = list(warped.warnings)
    if not shift.provenance.get("valid", True):
        notes.append("the field is marked as not valid: " + "; ".join(shift.provenance.get("reasons", [])))
    if deformation.jacobian.folded_elements or deformation.jacobian.smallest_around <= 0.0:
        notes.append(f"the field folds space in {deformation.jacobian.folded_elements} elements")
    error = deformation.inversion_error
    click.echo(f"inverse: mean error {m_to_mm(error.mean):.4f} mm, 95 % below {m_to_mm(error.p95):.4f} mm")
    for note in notes:
        click.echo(f"note: {note}")
    click.echo(f"wrote {output}" + (f" and {transform}" if transform else ""))

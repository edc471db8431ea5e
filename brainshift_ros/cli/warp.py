"""`brainshift warp`: displacement field and image to warped image, labels, surfaces, and an ITK transform."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np

from brainshift_ros.field.checks import Errors, MapChecks, check_map
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.field_file import read_field
from brainshift_ros.field.surfaces import PARTS, SURFACE_SUFFIXES, read_surface, warp_part, warp_surface, write_surface
from brainshift_ros.field.vacated import draw_cavity, draw_gap
from brainshift_ros.field.warp import WarpedImage, resample_through, warp_image
from brainshift_ros.files import atomic_path, writable_target
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.io import NIFTI_SUFFIXES, read_volume, write_volume
from brainshift_ros.image.itk import write_displacement_image
from brainshift_ros.image.volume import Volume
from brainshift_ros.units import m_to_mm

_PATH = click.Path(path_type=Path)


@click.command()
@click.argument("field", type=_PATH)
@click.argument("image", type=_PATH)
@click.option("-o", "--output", type=_PATH, required=True, help="Warped image to write (NIfTI).")
@click.option("--transform", type=_PATH, help="Also write the displacement transform (NIfTI, for ITK).")
@click.option(
    "--std", "std_path", type=_PATH, help="Also write the shift's standard deviation in mm (NIfTI); NaN off the brain."
)
@click.option("--labels", type=(_PATH, _PATH), metavar="IN OUT", multiple=True,
              help="Also warp a label image, on its own grid (repeatable).")  # fmt: skip
@click.option("--surface", "surfaces", type=(str, _PATH), metavar="WHAT OUT", multiple=True,
              help=f"Also move a surface: {', '.join(PARTS)}, or a file in mm, RAS ({', '.join(SURFACE_SUFFIXES)}; "
              "repeatable). OUT is written in mm, RAS, with shift and standard deviation.")  # fmt: skip
@click.option("--image-is-labels", is_flag=True, help="IMAGE itself holds labels: no new values.")
@click.option("--gap", type=float, metavar="VALUE",
              help="Hold the skull still, and draw what the brain has left at VALUE (air is 0).")  # fmt: skip
@click.option("--cavity", type=float, metavar="VALUE", help="The tumour was resected: draw its cavity at VALUE.")
@click.option("--json", "json_path", type=_PATH, help="Also write the checks of the map as JSON.")
def command(
    field: Path,
    image: Path,
    output: Path,
    transform: Path | None,
    std_path: Path | None,
    labels: tuple[tuple[Path, Path], ...],
    surfaces: tuple[tuple[str, Path], ...],
    image_is_labels: bool,
    gap: float | None,
    cavity: float | None,
    json_path: Path | None,
) -> None:
    """Bring a preoperative IMAGE to where FIELD says the brain is now, on the image's own grid.

    The transform is a NIfTI vector image in LPS mm that ITK, SimpleITK, ANTs and 3D Slicer read: it takes each point of
    the updated image to where it was before surgery, as resampling needs. Gap and cavity are drawn into the image alone:
    no transform can hold them.
    """
    for target in filter(None, (output, transform, std_path, *(out for _, out in labels))):
        writable_target(target, NIFTI_SUFFIXES)
    for _, target in surfaces:
        writable_target(target, SURFACE_SUFFIXES)
    if json_path is not None:
        writable_target(json_path)
    shift = read_field(field)
    volume = read_volume(image)
    label_images = [(read_volume(path), target) for path, target in labels]
    deformation = Deformation(shift)
    moved = [
        (warp_part(deformation, what) if what in PARTS else warp_surface(deformation, read_surface(what)), target)
        for what, target in surfaces
    ]
    warped = warp_image(deformation, volume, interpolation="labels" if image_is_labels else "linear")
    owner = deformation.owner_now(warped.grid)
    updated = warped.volume if gap is None else draw_gap(warped.volume, volume, deformation, owner, gap)
    updated = updated if cavity is None else draw_cavity(updated, deformation, owner, cavity)
    write_volume(output, updated)
    if transform is not None:
        write_displacement_image(transform, warped.inverse, warped.grid)
    if std_path is not None:
        std_mm = m_to_mm(deformation.std_on(warped.grid)).astype(np.float32)
        write_volume(std_path, Volume(std_mm, warped.grid.T_patient_voxel))
    for label_image, target in label_images:
        write_volume(target, _warped_labels(deformation, label_image, warped))
    for surface, target in moved:
        write_surface(target, surface)

    checks = check_map(deformation, warped.inverse, warped.grid, owner)
    notes = [*warped.warnings, *checks.warnings, *_remarks(shift.provenance, cavity)]
    if json_path is not None:
        with atomic_path(json_path) as temporary:
            report = checks.to_json() | {"warnings": notes}
            temporary.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    for line in _described(checks):
        click.echo(line)
    for note in notes:
        click.echo(f"note: {note}")
    written = [output, *filter(None, (transform, std_path, json_path)), *(out for _, out in (*labels, *surfaces))]
    click.echo("wrote " + ", ".join(str(path) for path in written))


def _warped_labels(deformation: Deformation, labels: Volume, image: WarpedImage) -> Volume:
    """Warp labels on their own grid; labels are mostly drawn on the image's, where the map is known already."""
    grid = Grid.of(labels)
    if grid.shape == image.grid.shape and np.allclose(grid.T_patient_voxel, image.grid.T_patient_voxel, rtol=0.0, atol=1e-9):
        return resample_through(labels, image.inverse, grid, "labels")
    return warp_image(deformation, labels, interpolation="labels").volume


def _described(checks: MapChecks) -> list[str]:
    def errors(name: str, found: Errors) -> str:
        mean, p95, largest = (float(m_to_mm(value)) for value in (found.mean, found.p95, found.largest))
        return f"{name} mean {mean:.3f}, 95 % below {p95:.3f}, largest {largest:.3f} mm"

    return [
        f"largest shift {float(m_to_mm(checks.largest_shift)):.1f} mm; smallest Jacobian {checks.jacobian_brain:.2f} in the "
        f"brain, {checks.jacobian_around:.2f} around it; {checks.folded_cells} of the image's cells fold, "
        f"{checks.folded_cells_at_sheets} of them at septa or surface, {checks.folded_cells_around} outside the brain",
        errors("forward after inverse, brain:", checks.inverse_brain),
        errors("forward after inverse, around:", checks.inverse_around),
        errors("between voxels, brain:", checks.sampling_brain),
        errors("between voxels, within a voxel of septa and surface:", checks.sampling_sheets),
    ]


def _remarks(provenance: Mapping[str, Any], cavity: float | None) -> list[str]:
    """Repeat what the estimate that made the field has to say."""
    remarks = []
    if not provenance.get("valid", True):
        remarks.append("the field is marked as not valid: " + "; ".join(provenance.get("reasons", [])))
    if cavity is None and provenance.get("resected_share", 0.0) > 0.5:
        remarks.append("the estimate says that the tumour was resected; it is still drawn, --cavity VALUE draws what is left")
    return remarks

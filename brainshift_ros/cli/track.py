"""`brainshift track`: the scans of a recorded case to homologous points, without ROS nodes."""

from __future__ import annotations

from pathlib import Path

import click

from brainshift_ros.correspondence.guides_file import read_guides
from brainshift_ros.correspondence.tracking import TrackingOptions
from brainshift_ros.files import writable_target
from brainshift_ros.inverse.points_csv import write_homologous_points
from brainshift_ros.mesh.patient_file import read_patient
from brainshift_ros.pictures.scan import scan_page
from brainshift_ros.registration.fiducials import register_fiducials
from brainshift_ros.registration.fiducials_file import read_fiducials
from brainshift_ros.session.bag import track_bag
from brainshift_ros.session.planned_area import planned_area
from brainshift_ros.session.session import LrsOptions, LrsSession
from brainshift_ros.units import mm_to_m

_FILE = click.Path(path_type=Path)


@click.command()
@click.argument("bag", type=_FILE)
@click.option("--patient", required=True, type=_FILE, help="Patient file (HDF5).")
@click.option("-o", "--output", required=True, type=_FILE, help="CSV to write: x y z dx dy dz sigma, in mm, RAS.")
@click.option("--fiducials", type=_FILE, help="Paired fiducials (YAML, mm) to start from, rather than from the bag's pose.")
@click.option("--scene", type=_FILE, help="Scene (YAML): without fiducials and pose, search only near its craniotomy.")
@click.option("--guides", type=_FILE, help="A person's marks (YAML, pixels) in the first and in the last scan.")
@click.option("--tracker-mm", type=click.FloatRange(0.0, 5.0), default=TrackingOptions.tracker_mm, show_default=True,
              help="RMS error of the scanner's tracked position, mm; a part of sigma.")  # fmt: skip
@click.option("--page", type=_FILE, help="Picture to write (PNG): both scans, vessels, motion of the points.")
@click.option("--dense", "dense_mm", type=click.FloatRange(1.0, 20.0),
              help="Also write a dense field of this spacing in mm, beside OUTPUT with _dense in its name; its sigma "
                   "is raised so that the points may be weighed as independent ones.")  # fmt: skip
def command(
    bag: Path,
    patient: Path,
    output: Path,
    fiducials: Path | None,
    scene: Path | None,
    guides: Path | None,
    tracker_mm: float,
    page: Path | None,
    dense_mm: float | None,
) -> None:
    """Register the first scan of BAG, find its points in the later ones, and write those of the last.

    BAG is a rosbag2 folder or an .mcap file with lrs/points and, if there is one, lrs/initial_pose: what the node lrs takes.
    The registration starts from the fiducials, else from the pose, else the cortex is searched. Scans that cannot be used are
    named and passed over. Guides take the place of the automatic match between first and last scan. `brainshift solve` reads
    OUTPUT.
    """
    dense_output = output.with_name(f"{output.stem}_dense{output.suffix}")
    for target in (output, *([dense_output] if dense_mm else ())):
        writable_target(target)
    if page is not None:
        writable_target(page, (".png",))
    marks = None if guides is None else read_guides(guides)
    start = None
    if fiducials is not None:
        given = read_fiducials(fiducials)
        start = register_fiducials(given.tracker, given.patient, given.fle_m)
    near = None if scene is None else planned_area(scene)
    options = LrsOptions(tracking=TrackingOptions(tracker_mm=tracker_mm))
    session = LrsSession(read_patient(patient).cortex, options, near=near)

    tracked = track_bag(session, bag, lambda name, line: click.echo(f"{name}: {line}"), fiducials=start, marks=marks)
    write_homologous_points(output, tracked.homologous)
    click.echo(f"wrote {output}: {len(tracked.homologous.points)} points")
    if dense_mm is not None:
        field = session.dense(float(mm_to_m(dense_mm)))
        write_homologous_points(dense_output, field.as_independent_points())
        click.echo("; ".join((f"wrote {dense_output}: {len(field.points)} points", *field.warnings)))
    if page is not None:
        scan_page(page, tracked.first, session.vessels(), tracked.last, tracked.homologous)
        click.echo(f"wrote {page}")

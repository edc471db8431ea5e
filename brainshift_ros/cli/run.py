"""`brainshift run`: start the node graph where no `ros2` is installed."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path
from types import FrameType

import click
import yaml

from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.errors import InputError
from brainshift_ros.files import existing_file
from brainshift_ros.mesh.patient_file import read_patient
from brainshift_ros.runner import Graph, Respawner, case_parameters

POLL_S = 0.2


@click.command()
@click.option("--atlas", "atlas_file", required=True, type=click.Path(path_type=Path), help="atlas file (HDF5)")
@click.option("--patient", "patient_file", required=True, type=click.Path(path_type=Path), help="patient file (HDF5)")
@click.option("--image", "image_file", type=click.Path(path_type=Path), help="T1 MR (NIfTI) for the service inverse/warp_image")
@click.option(
    "--scene", "scene_file", type=click.Path(path_type=Path), help="scene (YAML): its craniotomy narrows a search for the scan"
)
@click.option(
    "--fiducials", "fiducials_file", type=click.Path(path_type=Path), help="paired fiducials (YAML) to start the registration"
)
@click.option(
    "--guides", "guides_file", type=click.Path(path_type=Path), help="marks in two scans (YAML) for the service lrs/guide"
)
@click.option("--output-dir", type=click.Path(path_type=Path), help="where warp_image writes")
@click.option(
    "--params", "params_files", multiple=True, type=click.Path(path_type=Path), help="ROS 2 parameter file (repeatable)"
)
@click.option("--domain-id", type=click.IntRange(0, 232), help="ROS_DOMAIN_ID of a graph on this machine alone")
def command(
    atlas_file: Path,
    patient_file: Path,
    image_file: Path | None,
    scene_file: Path | None,
    fiducials_file: Path | None,
    guides_file: Path | None,
    output_dir: Path | None,
    params_files: tuple[Path, ...],
    domain_id: int | None,
) -> None:
    """Start atlas_loader, lrs, retractor and inverse; Ctrl-C ends them. A node that ends is started again."""
    _check_case(atlas_file, patient_file, image_file)
    if scene_file is not None:
        existing_file(scene_file, "scene (YAML)")
    for path in params_files:
        _check_params(path)
    parameters = case_parameters(
        atlas_file,
        patient_file,
        image_file=image_file,
        output_dir=output_dir,
        scene_file=scene_file,
        fiducials_file=fiducials_file,
        guides_file=guides_file,
    )
    signal.signal(signal.SIGTERM, _interrupt)
    with Graph(parameters, params_files=[path.resolve() for path in params_files], domain_id=domain_id) as running:
        respawner = Respawner(running, lambda line: click.echo(f"brainshift: {line}", err=True))
        try:
            while respawner.look_after():
                time.sleep(POLL_S)
        except KeyboardInterrupt:
            return
    sys.exit(1)


def _check_case(atlas_file: Path, patient_file: Path, image_file: Path | None) -> None:
    """Refuse what the nodes would refuse, before they start, and an atlas of another patient."""
    with open_atlas(atlas_file) as atlas:
        built_for = atlas.patient_id
    found = read_patient(patient_file).patient_id
    if built_for != found:
        problem = f"was built for patient {built_for[:12]}, not for {found[:12]} of {patient_file}"
        raise InputError(atlas_file, problem, "give the atlas and the patient file of one patient")
    if image_file is not None:
        existing_file(image_file, "T1 MR (NIfTI)")


def _check_params(path: Path) -> None:
    remedy = "see config/nodes.yaml for an example"
    try:
        content = yaml.safe_load(existing_file(path, "ROS 2 parameter file (YAML)").read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(path, f"is not YAML: {error}", remedy) from error
    if not isinstance(content, dict) or not all(
        isinstance(section, dict) and isinstance(section.get("ros__parameters"), dict) for section in content.values()
    ):
        raise InputError(path, "has no `ros__parameters` under each node's name", remedy)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt

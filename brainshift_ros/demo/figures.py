"""The demo's pictures and image files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from brainshift_ros.demo.preparation import Progress
from brainshift_ros.demo.recording import RecordedCase
from brainshift_ros.demo.session import Session
from brainshift_ros.demo.settings import DemoFiles
from brainshift_ros.field.checks import check_map
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.warp import warp_image
from brainshift_ros.files import atomic_path
from brainshift_ros.geometry import transform_points
from brainshift_ros.graph import PATIENT_FRAME
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.io import write_volume
from brainshift_ros.image.itk import write_displacement_image
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.pictures.boundary import BoundaryCase, boundary_figure
from brainshift_ros.pictures.field import displacement_map, mr_before_after, vectors_on_cortex
from brainshift_ros.pictures.patient_page import patient_page
from brainshift_ros.pictures.scan import scan_page
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.session.session import LrsSession


def draw_all(
    files: DemoFiles,
    patient: PatientModel,
    t1: Volume,
    labels: Volume,
    case: RecordedCase,
    session: Session,
    field: DisplacementField,
    progress: Progress,
) -> dict[str, Any]:
    """Write the updated MR, both displacement images and the pictures; return the checks of the map, as JSON."""
    deformation, grid = Deformation(field), Grid.of(t1)
    progress("updated MR", 0.1)
    warped = warp_image(deformation, t1)
    forward = deformation.forward_on(grid)
    write_volume(files.warped, warped.volume)
    write_displacement_image(files.transform, warped.inverse, grid)
    write_displacement_image(files.forward, forward, grid)

    tumor = patient.mesh.nodes[patient.mesh.elements[patient.mesh.region == Region.TUMOR]].mean(axis=(0, 1))
    progress("slices", 0.5)
    mr_before_after(files.folder / "mr_before_after.png", t1, warped.volume, warped.inverse, tumor)
    displacement_map(files.folder / "displacement_mm.png", t1, forward, deformation.inside(grid), tumor)
    progress("mesh", 0.7)
    patient_page(patient, t1, labels, files.folder / "patient.png")
    _draw_boundary(files, case)
    progress("scan", 0.8)
    _draw_scans(files, patient, case, session)
    progress("vectors", 0.9)
    _draw_vectors(files, patient, session, field)
    return check_map(deformation, warped.inverse, grid, deformation.owner_now(grid)).to_json()


def _draw_boundary(files: DemoFiles, case: RecordedCase) -> None:
    """Draw the truth's boundary conditions, as figure 5 of the thesis does the atlas's."""
    figure = boundary_figure(case.truth.mesh, [BoundaryCase("truth", case.truth.solution.kinds)])
    with atomic_path(files.folder / "boundary.png") as temporary:
        figure.savefig(temporary, dpi=110)


def _draw_scans(files: DemoFiles, patient: PatientModel, case: RecordedCase, session: Session) -> None:
    """Draw what the `lrs` node saw; the vessels, which travel on no topic, are traced again as it does."""
    lrs = LrsSession(patient.cortex)
    lrs.set_initial_pose(case.T_patient_tracker_initial)
    update = lrs.add_scan(case.first.scan)
    if update.registered is None:
        raise RuntimeError("the first scan was refused outside the graph though the graph accepted it")
    first, later = (_in_patient(scan.scan, session.T_patient_tracker) for scan in (case.first, case.later))
    scan_page(files.folder / "scan_vessels.png", first, lrs.vessels(), later, session.homologous)


def _draw_vectors(files: DemoFiles, patient: PatientModel, session: Session, field: DisplacementField) -> None:
    points = session.homologous.points
    located = PointLocator(field.mesh).locate(points, max_outside_m=10e-3)
    predicted = located.interpolate(field.mesh, field.displacement)[located.found]
    measured = session.homologous.displacements[located.found]
    vectors_on_cortex(files.folder / "vectors.png", patient.cortex, points[located.found], measured, predicted)


def _in_patient(scan: OrganisedScan, T_patient_tracker: np.ndarray) -> OrganisedScan:
    points = transform_points(T_patient_tracker, scan.points).astype(np.float32)
    return replace(scan, points=points, frame_id=PATIENT_FRAME)

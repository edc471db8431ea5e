"""The whole job once: image, mesh, atlas, recorded case, graph, field, pictures, figures."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from brainshift_ros import __version__
from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.demo.evaluation import evaluate_field, measured_point_errors_mm, registration_errors_mm
from brainshift_ros.demo.figures import draw_all
from brainshift_ros.demo.preparation import make_images, make_patients
from brainshift_ros.demo.recording import RecordedCase, simulate_case, write_case
from brainshift_ros.demo.session import Session, run_session
from brainshift_ros.demo.settings import DemoFiles, DemoSettings
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.field_file import write_field
from brainshift_ros.files import atomic_path
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.runner import require_ros

#: Called with the stage's name and the fraction of it that is done.
Progress = Callable[[str, float], None]

_PACKAGES = (
    "numpy",
    "scipy",
    "h5py",
    "scikit-fem",
    "libigl",
    "opencv-python-headless",
    "pytetwild",
    "ros-rclpy",
    "rosbags",
)


class _Stages:
    """Times the stages and forwards their progress."""

    def __init__(self, progress: Progress) -> None:
        self.times_s: dict[str, float] = {}
        self._progress = progress

    @contextmanager
    def stage(self, name: str) -> Iterator[Progress]:
        def report(detail: str, fraction: float) -> None:
            self._progress(f"{name}: {detail}" if detail else name, fraction)

        self._progress(name, 0.0)
        begin = perf_counter()
        yield report
        self.times_s[name] = round(perf_counter() - begin, 3)
        self._progress(name, 1.0)


def run_demo(scene: Scene, settings: DemoSettings, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run everything; return what ``summary.json`` holds.

    Parameters
    ----------
    scene
        Gravity with a craniotomy; ``config/scene_demo.yaml``.
    settings
        Sizes and seeds.
    folder
        Where results go; made if missing. Meshes that lie there from an earlier run are kept.
    progress
        Stage and fraction of it.
    """
    require_ros()  # before minutes of work, not after them
    folder.mkdir(parents=True, exist_ok=True)
    files = DemoFiles(folder)
    stages = _Stages(progress)
    begin = perf_counter()
    with stages.stage("image"):
        images = make_images(settings, files)
    with stages.stage("mesh") as report:
        patient, truth_patient, kept = make_patients(settings, files, images, report)
    with stages.stage("atlas") as report:
        build = build_atlas(patient, scene, files.atlas, progress=report)
    with open_atlas(files.atlas) as atlas:
        mesh, patient_id, entries = atlas.mesh, atlas.patient_id, len(atlas.entries)
        with stages.stage("case"):
            case = simulate_case(settings, atlas, truth_patient, images)
            write_case(case, files)
    with stages.stage("graph"):
        session = run_session(files)
    with stages.stage("field"):
        field = _field_of(session, mesh, patient_id)
        write_field(files.field, field)
        groups = evaluate_field(case, field)
    with stages.stage("pictures") as report:
        image_checks = draw_all(files, patient, images.t1, images.labels, case, session, field, report)
    stages.times_s["total"] = round(perf_counter() - begin, 3)
    stages.times_s["scan_to_field"] = round(session.scan_to_field_s, 3)

    summary = _summary(case, session, groups, mesh)
    summary |= {
        "atlas_entries": entries,
        "atlas_residual": build.residual,
        "mesh_kept": kept,
        "patient_quality": dict(patient.quality),
        "warnings": {"patient": list(patient.warnings), "atlas": list(build.warnings)},
        "solver": build.solver,
        "updated_image": image_checks,
        "times_s": stages.times_s,
        "versions": {
            "brainshift_ros": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in _PACKAGES},
        },
    }
    with atomic_path(files.summary) as temporary:
        temporary.write_text(json.dumps(summary, indent=1), encoding="utf-8")
    return summary


def _field_of(session: Session, mesh: TetMesh, patient_id: str) -> DisplacementField:
    """Put the published cloud back on the mesh; it must be that mesh's nodes in their order."""
    if session.field.points.shape != mesh.nodes.shape or not np.allclose(session.field.points, mesh.nodes, atol=1e-6):
        raise RuntimeError("the published field is not at the atlas's nodes")
    estimate = session.estimate
    provenance = {"patient_id": patient_id, "valid": estimate["valid"], "reasons": estimate["reasons"], "estimate": estimate}
    return DisplacementField(mesh, session.field.displacements, session.field.std, provenance)


def _summary(case: RecordedCase, session: Session, groups: dict[str, Any], mesh: TetMesh) -> dict[str, Any]:
    registration = registration_errors_mm(case, session)
    return {
        "shift_mm_mean": groups["surface"].shift_mm_mean,
        "correction_surface_percent": groups["surface"].correction_percent,
        "correction_subsurface_percent": groups["subsurface"].correction_percent,
        "registration_tre_mm": registration["cortex"],
        "registration_tre_tumor_mm": registration["tumor"],
        "registration_start_error_mm": registration["start"],
        "homologous_points": len(session.homologous.points),
        "homologous_error_mm": measured_point_errors_mm(case, session),
        "nonzero_weights": session.estimate["nonzero_weights"],
        "field_valid": session.estimate["valid"],
        "field_reasons": session.estimate["reasons"],
        "nodes": len(mesh.nodes),
        "elements": len(mesh.elements),
        "truth_nodes": len(case.truth.mesh.nodes),
        "targets": {name: asdict(group) for name, group in groups.items()},
    }

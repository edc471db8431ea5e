"""One atlas of :mod:`brainshift_ros.experiments.scaling`, in a process of its own so that its peak memory is its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.scene import read_scene
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.mesh.patient_file import read_patient


def main(patient_path: Path, scene_path: Path, atlas_path: Path, made: Path) -> None:
    """Build the atlas and write its figures."""
    patient, scene = read_patient(patient_path), read_scene(scene_path)
    with Stopwatch() as watch:
        report = build_atlas(patient, scene, atlas_path)
    row = {
        "nodes": len(patient.mesh.nodes),
        "elements": len(patient.mesh.elements),
        "entries": report.entries,
        "wall, s": watch.wall_s,
        "CPU, s": watch.cpu_s,
        **{f"{stage}, s": seconds for stage, seconds in report.times_s.items()},
        "residual": report.residual,
        "file, MB": atlas_path.stat().st_size / 1e6,
    }
    made.write_text(json.dumps(row), encoding="utf-8")


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:5]))

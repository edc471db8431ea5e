"""One size of :mod:`brainshift_ros.experiments.meshing`, in a process of its own so that its peak memory is its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.patient import ImageReference
from brainshift_ros.mesh.template_patient import template_patient_images
from brainshift_ros.septa.sheets import septa_spacing_mm


def main(nodes: int, made: Path) -> None:
    """Build the template's patient model and write its figures with wall and processor time."""
    images = template_patient_images(septa_spacing_mm=septa_spacing_mm(nodes))
    image = ImageReference("template", "0" * 64, images.t1.shape, images.t1.T_patient_voxel)
    with Stopwatch() as watch:
        patient = build_patient(images.t1, images.labels, images.septa, image_ref=image, nodes=nodes)
    row = {"nodes": patient.quality["nodes"], "wall, s": watch.wall_s, "CPU, s": watch.cpu_s}
    made.write_text(json.dumps({**row, **patient.quality}), encoding="utf-8")


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))

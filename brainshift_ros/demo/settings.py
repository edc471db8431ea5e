"""What the demo does, as values; tests run the same code with smaller ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from brainshift_ros.image.tumor import TumorShape


@dataclass(frozen=True)
class DemoSettings:
    """Sizes, seeds and perturbations of the demo.

    Attributes
    ----------
    nodes, truth_nodes
        Wanted mesh sizes of the patient model and of the truth, which shall differ.
    septa_spacing_mm
        Resolution of the septa's sheets; near the mesh's edge length.
    tumor
        The drawn tumour.
    scan_width, scan_height
        Pixels of the simulated scanner.
    case_seed
        Decides the truth's stiffness, vessels, scanner noise and tracker pose.
    start_rotation_deg, start_translation_mm
        How wrong the initial pose in the bag is.
    fluid_level_offset
        Fluid level of the truth above the atlas's (fraction of the head's extent): its level is not in the atlas either.
    """

    nodes: int = 20_000
    truth_nodes: int = 12_000
    septa_spacing_mm: float = 5.0
    tumor: TumorShape = field(default_factory=TumorShape)
    scan_width: int = 640
    scan_height: int = 480
    case_seed: int = 7
    start_rotation_deg: float = 6.0
    start_translation_mm: float = 5.0
    fluid_level_offset: float = 0.03


def _file(name: str) -> property:
    return property(lambda self: self.folder / name)


@dataclass(frozen=True)
class DemoFiles:
    """Where the demo's results lie."""

    folder: Path

    t1 = _file("t1.nii.gz")
    labels = _file("labels.nii.gz")
    patient = _file("patient.h5")
    truth_patient = _file("truth_patient.h5")
    made_from = _file("made_from.json")
    atlas = _file("atlas.h5")
    case_bag = _file("case.mcap")
    session_bag = _file("session.mcap")
    field = _file("field.h5")
    forward = _file("displacement_forward.nii.gz")
    transform = _file("transform_resampling.nii.gz")
    warped = _file("t1_warped.nii.gz")
    summary = _file("summary.json")
    log = _file("nodes.log")

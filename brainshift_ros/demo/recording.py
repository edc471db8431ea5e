"""The recorded case: a truth that is not in the atlas, scanned before and after, written as a bag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.atlas.file import AtlasFile
from brainshift_ros.atlas.problem import under_craniotomy
from brainshift_ros.bags import BagWriter
from brainshift_ros.demo.settings import DemoFiles, DemoSettings
from brainshift_ros.geometry import invert_rigid, rigid, transform_points, unit
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.template_patient import TemplateImages
from brainshift_ros.simulation.scanner import Scanner, SimulatedScan, scanner_pose, take_scan
from brainshift_ros.simulation.scene import SurgicalScene, make_scene
from brainshift_ros.simulation.truth import Truth, direction_between, simulate_truth, smooth_random_field
from brainshift_ros.surface.cortex import cortical_surface
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import vertex_normals
from brainshift_ros.units import mm_to_m

#: Times of the recording: any fixed moment serves, and a fixed one gives the same bag each time.
FIRST_SCAN_NS = 1_700_000_000_000_000_000
POSE_BEFORE_SCAN_NS = 500_000_000
BETWEEN_SCANS_NS = 4_000_000_000

#: The scanned cortex is extracted otherwise than the registration's target (3.0 and 0.8 mm), and differs from it by what an
#: MR and its segmentation get wrong: a smooth error along the normal.
TRUTH_CLOSING_MM = 2.5
TRUTH_SMOOTHING_MM = 0.6
SEGMENTATION_ERROR_MM = 0.4
SEGMENTATION_ERROR_LENGTH_MM = 6.0


@dataclass(frozen=True)
class RecordedCase:
    """What was recorded, and what really happened.

    Attributes
    ----------
    truth
        The forward solution behind the second scan.
    scene
        Cortex, vessels and craniotomy as the scanner sees them.
    first, later
        The scans with their truth.
    T_patient_tracker
        The true transform.
    T_patient_tracker_initial
        The one in the bag.
    """

    truth: Truth
    scene: SurgicalScene
    first: SimulatedScan
    later: SimulatedScan
    T_patient_tracker: NDArray[np.float64]
    T_patient_tracker_initial: NDArray[np.float64]


def simulate_case(
    settings: DemoSettings, atlas: AtlasFile, truth_patient: PatientModel, images: TemplateImages
) -> RecordedCase:
    """Solve the truth, with one-sided skull contact, and scan its cortex twice.

    The truth has another mesh, another stiffness, an orientation as far as can be from the atlas's own, another fluid level,
    and a cortex that differs from the registration's target by a segmentation error.
    """
    gravity, craniotomy = atlas.scene.gravity, atlas.scene.craniotomy
    if gravity is None or craniotomy is None:
        raise ValueError("the demo's scene must name gravity and a craniotomy")
    direction = direction_between(
        [entry.gravity_direction for entry in atlas.entries], gravity.direction, np.radians(gravity.cone_deg)
    )
    level = max(entry.fluid_level for entry in atlas.entries) + settings.fluid_level_offset
    # Whatever the atlas assumes: a brain does not pass through bone.
    opening = under_craniotomy(truth_patient.mesh, craniotomy)
    truth = simulate_truth(truth_patient, direction, level, seed=settings.case_seed, skull="contact", opening=opening)

    cortex = _true_cortex(images, settings.case_seed)
    scene = make_scene(cortex, mm_to_m(craniotomy.center_mm), float(mm_to_m(craniotomy.diameter_mm)), settings.case_seed)
    rng = np.random.default_rng(settings.case_seed)
    T_patient_tracker = rigid(Rotation.random(rng=rng), rng.uniform(-0.4, 0.4, 3))
    scanner = Scanner(width=settings.scan_width, height=settings.scan_height)
    first = take_scan(
        scene,
        T_patient_tracker,
        scanner_pose(scene.craniotomy, scanner, tilt_deg=6.0, azimuth_deg=30.0, roll_deg=0.0),
        seed=settings.case_seed + 1,
        scanner=scanner,
        stamp_ns=FIRST_SCAN_NS,
    )
    later = take_scan(
        scene,
        T_patient_tracker,
        scanner_pose(scene.craniotomy, scanner, tilt_deg=9.0, azimuth_deg=-40.0, roll_deg=4.0),
        seed=settings.case_seed + 2,
        displacement=truth.displacement_at,
        scanner=scanner,
        stamp_ns=FIRST_SCAN_NS + BETWEEN_SCANS_NS,
    )
    return RecordedCase(truth, scene, first, later, T_patient_tracker, _disturbed(T_patient_tracker, scene, settings, rng))


def write_case(case: RecordedCase, files: DemoFiles) -> None:
    """Write initial pose and both scans as a bag."""
    with BagWriter(files.case_bag, replace=True) as bag:
        bag.add_initial_pose(case.T_patient_tracker_initial, FIRST_SCAN_NS - POSE_BEFORE_SCAN_NS)
        bag.add_scan(case.first.scan)
        bag.add_scan(case.later.scan)


def _true_cortex(images: TemplateImages, seed: int) -> Surface:
    extracted = cortical_surface(images.t1, images.labels, closing_mm=TRUTH_CLOSING_MM, smoothing_mm=TRUTH_SMOOTHING_MM)
    length = float(mm_to_m(SEGMENTATION_ERROR_LENGTH_MM))
    error = smooth_random_field(extracted.vertices, length, np.random.default_rng(seed), modes=256)
    normals = vertex_normals(extracted.vertices, extracted.faces)
    return Surface(extracted.vertices + mm_to_m(SEGMENTATION_ERROR_MM) * error[:, None] * normals, extracted.faces)


def _disturbed(
    T_patient_tracker: NDArray[np.float64], scene: SurgicalScene, settings: DemoSettings, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Turn and shift the pose about the craniotomy by the settings' amounts, in random directions."""
    center = scene.craniotomy.center
    turn = Rotation.from_rotvec(np.radians(settings.start_rotation_deg) * unit(rng.normal(size=3)))
    offset = mm_to_m(settings.start_translation_mm) * unit(rng.normal(size=3))
    about_center = rigid(turn, center - turn.apply(center) + offset)
    return about_center @ T_patient_tracker


def registration_error(
    case: RecordedCase, T_patient_tracker: NDArray[np.float64], targets: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Target registration error, shape (n,), metres: how far targets in the patient land from where they are."""
    in_tracker = transform_points(invert_rigid(case.T_patient_tracker), targets)
    return np.linalg.norm(transform_points(T_patient_tracker, in_tracker) - targets, axis=1)

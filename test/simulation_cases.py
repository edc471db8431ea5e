"""Real brain surfaces and smooth shifts for the tests of scans, registration and correspondence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from nilearn.datasets import load_mni152_brain_mask, load_mni152_template
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from brainshift_ros.geometry import invert_rigid, rigid, transform_points, unit
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.simulation.scanner import Scanner, SimulatedScan, scanner_pose, take_scan
from brainshift_ros.simulation.scene import SurgicalScene, make_scene
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import affine_mm_to_m, m_to_mm, mm_to_m

CENTER = mm_to_m([-35.0, 45.0, 50.0])
DIAMETER_M = 0.070
SMALL_SCANNER = Scanner(width=320, height=240)


@lru_cache
def mni_cortex(threshold: float = 0.42, smoothing_vox: float = 0.7) -> Surface:
    """Cortex of the MNI brain as an isosurface of its T1; two settings give two independent discretisations."""
    template = load_mni152_template(resolution=1)
    brain = np.asarray(load_mni152_brain_mask(resolution=1).dataobj) > 0
    t1 = np.asarray(template.dataobj, dtype=np.float32)
    inside = (t1 > threshold) & brain
    labels, _ = ndimage.label(inside)
    inside = labels == np.argmax(np.bincount(labels.ravel())[1:]) + 1
    inside = ndimage.binary_fill_holes(inside)
    soft = ndimage.gaussian_filter(np.pad(inside.astype(np.float32), 2), smoothing_vox)
    vertices, faces, _, _ = marching_cubes(soft, 0.5)
    corners = vertices[faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum()
    faces = faces if volume > 0 else faces[:, ::-1]
    points = transform_points(affine_mm_to_m(template.affine), vertices - 2.0)
    return Surface(points, np.ascontiguousarray(faces, dtype=np.int32))


@dataclass(frozen=True)
class ScanCase:
    """A scene, its first scan, and a later one after a known shift."""

    scene: SurgicalScene
    T_patient_tracker: np.ndarray
    shift: Callable[[np.ndarray], np.ndarray]
    first: SimulatedScan
    later: SimulatedScan

    @property
    def deep_target(self) -> np.ndarray:
        """A tumour's centroid: 28 mm below the cortex."""
        return self.scene.craniotomy.center - 0.028 * self.scene.craniotomy.axis

    def tre_mm(self, T_patient_tracker: np.ndarray) -> tuple[float, float]:
        """Registration error on the cortex (mean) and at the deep target."""
        error = T_patient_tracker @ invert_rigid(self.T_patient_tracker)
        seen = self.first.current[np.isfinite(self.first.current).all(axis=-1)][::100]
        surface = np.linalg.norm(transform_points(error, seen) - seen, axis=1).mean()
        deep = np.linalg.norm(transform_points(error, self.deep_target) - self.deep_target)
        return float(m_to_mm(surface)), float(m_to_mm(deep))

    def start(self, degrees: float, millimetres: float, seed: int = 0) -> np.ndarray:
        """The true pose turned and moved about the craniotomy."""
        rng = np.random.default_rng(seed)
        turn = Rotation.from_rotvec(np.deg2rad(degrees) * unit(rng.normal(size=3)))
        center = self.scene.craniotomy.center
        offset = mm_to_m(millimetres) * unit(rng.normal(size=3))
        return rigid(turn, center - turn.apply(center) + offset) @ self.T_patient_tracker


def sag(scene: SurgicalScene, peak_mm: float, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Smooth shift: mostly inward, with lateral motion and a little rotation, fading over 4 to 7 cm."""
    center, axis = scene.craniotomy.center, scene.craniotomy.axis
    direction = unit(-axis + 0.5 * rng.normal(size=3))
    middle = center + rng.normal(0.0, 12e-3, 3)
    length, spin = rng.uniform(0.04, 0.07), rng.normal(0.0, 0.05, 3)

    def shift(points: np.ndarray) -> np.ndarray:
        fade = np.exp(-0.5 * np.sum((points - middle) ** 2, axis=1) / length**2)[:, None]
        return fade * (mm_to_m(peak_mm) * direction + np.cross(spin, points - center))

    return shift


@lru_cache
def scan_case(seed: int, peak_mm: float = 8.0, scanner: Scanner = SMALL_SCANNER) -> ScanCase:
    """The MNI brain, opened on the left front, scanned before and after a shift; the scanner moves in between."""
    rng = np.random.default_rng(seed)
    scene = make_scene(mni_cortex(), CENTER, DIAMETER_M, seed)
    T_patient_tracker = rigid(Rotation.random(random_state=seed), rng.normal(0.0, 0.7, 3))
    tilt, azimuth, roll = rng.uniform(0, 15), rng.uniform(0, 360), rng.uniform(0, 360)
    shift = sag(scene, peak_mm, rng)
    first_pose = scanner_pose(scene.craniotomy, scanner, tilt, azimuth, roll)
    later_pose = scanner_pose(scene.craniotomy, scanner, tilt + 4.0, azimuth - 8.0, roll + 10.0)
    first = take_scan(scene, T_patient_tracker, first_pose, seed=2 * seed, scanner=scanner)
    later = take_scan(
        scene, T_patient_tracker, later_pose, seed=2 * seed + 1, displacement=shift, scanner=scanner, stamp_ns=8_000_000_000
    )
    return ScanCase(scene, T_patient_tracker, shift, first, later)


@lru_cache
def mni_target() -> CortexTarget:
    """Registration target from another isosurface than the one that is scanned."""
    return prepare_target(mni_cortex(0.47, 1.0))

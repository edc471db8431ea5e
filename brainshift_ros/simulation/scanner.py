"""A simulated laser range scanner: organised textured clouds with noise, dropouts and specular spots, and the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, transform_points, unit
from brainshift_ros.graph import TRACKER_FRAME
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.simulation.cavity import Cavity, cavity_wall
from brainshift_ros.simulation.craniotomy import Craniotomy
from brainshift_ros.simulation.instruments import Instrument
from brainshift_ros.simulation.lighting import Illumination, Lighting, coaxial_lamp, shade, soften
from brainshift_ros.simulation.scan_parts import Part, RayScene, Seen, Traced
from brainshift_ros.simulation.scene import SurgicalScene
from brainshift_ros.simulation.texture import smooth_noise
from brainshift_ros.surface.surface import Surface

Displacement = Callable[[NDArray[np.float64]], NDArray[np.float64]]

_SHADOW_CLEARANCE_M = 0.5e-3


@dataclass(frozen=True)
class Scanner:
    """Optics and defects of the scanner.

    Attributes
    ----------
    width, height
        Pixels.
    view_m
        Width of the field of view at `distance_m`, metres.
    distance_m
        Working distance, metres.
    range_noise_m
        Standard deviation of the range along each ray, metres.
    dropout_fraction
        Share of the cortex lost in random patches.
    color_noise
        Standard deviation of the colour, 0 to 1.
    speculars
        Whether wet spots glint (and lose range).
    """

    width: int = 640
    height: int = 480
    view_m: float = 0.115
    distance_m: float = 0.30
    range_noise_m: float = 0.3e-3
    dropout_fraction: float = 0.02
    color_noise: float = 0.012
    speculars: bool = True

    def rays(self) -> NDArray[np.float64]:
        """Return unit ray directions in the scanner frame (z forward, x right, y down), shape (H, W, 3)."""
        focal = self.width * self.distance_m / self.view_m
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x, y = (u - 0.5 * (self.width - 1)) / focal, (v - 0.5 * (self.height - 1)) / focal
        return unit(np.stack([x, y, np.ones_like(x)], axis=-1))


@dataclass(frozen=True)
class SimulatedScan:
    """A scan and what really was where.

    Attributes
    ----------
    scan
        What the scanner delivers, tracker frame.
    T_patient_tracker
        The true transform.
    material
        Shape (H, W, 3), metres, patient frame: where the seen tissue was *before* the shift; NaN off the cortex.
    current
        Shape (H, W, 3), metres, patient frame: where it is in this scan, without noise; NaN off the cortex.
    specular
        Shape (H, W), strength of the glint, 0 to 1.
    label
        Shape (H, W), uint8, values of :class:`Seen`.
    T_error
        4x4, tracker frame: the tracker's error in this scan's points.
    """

    scan: OrganisedScan
    T_patient_tracker: NDArray[np.float64]
    material: NDArray[np.float64]
    current: NDArray[np.float64]
    specular: NDArray[np.float32]
    label: NDArray[np.uint8]
    T_error: NDArray[np.float64]


def scanner_pose(
    craniotomy: Craniotomy, scanner: Scanner, tilt_deg: float, azimuth_deg: float, roll_deg: float
) -> NDArray[np.float64]:
    """T_patient_scanner of a scanner that looks at the opening from `tilt_deg` off its axis."""
    R_patient_craniotomy = craniotomy.T_craniotomy_patient[:3, :3].T
    turn = Rotation.from_euler("ZXZ", [azimuth_deg, tilt_deg, roll_deg - azimuth_deg], degrees=True)
    looking_down = Rotation.from_euler("x", 180, degrees=True)
    T = np.eye(4)
    T[:3, :3] = R_patient_craniotomy @ (turn * looking_down).as_matrix()
    T[:3, 3] = craniotomy.center - scanner.distance_m * T[:3, 2]
    return T


def take_scan(
    scene: SurgicalScene,
    T_patient_tracker: NDArray[np.float64],
    T_patient_scanner: NDArray[np.float64],
    *,
    seed: int,
    displacement: Displacement | NDArray[np.float64] | None = None,
    scanner: Scanner | None = None,
    stamp_ns: int = 0,
    lighting: Lighting | None = None,
    instruments: tuple[Instrument, ...] = (),
    cavity: Cavity | None = None,
    T_error: NDArray[np.float64] | None = None,
) -> SimulatedScan:
    """Scan the scene once.

    Parameters
    ----------
    scene
        From :func:`brainshift_ros.simulation.scene.make_scene`.
    T_patient_tracker
        4x4, tracker to patient; the scan is delivered in tracker space.
    T_patient_scanner
        4x4, scanner (z forward) to patient, as :func:`scanner_pose` gives it.
    seed
        Decides noise, dropouts, glints and, without `lighting`, the light of this scan.
    displacement
        Shift of the cortex: a function of points (n, 3) in metres, or an array (V, 3) over the vertices of the surface
        that the scene was made from. None: no shift.
    scanner
        Optics; :class:`Scanner` by default.
    stamp_ns
        Time of acquisition.
    lighting
        The operating lamp; by default a lamp beside the scanner.
    instruments
        What lies or is held over the field.
    cavity
        Where tissue was taken out; it moves with `displacement`.
    T_error
        4x4, tracker frame: an error of the tracker, applied to the delivered points.
    """
    scanner = scanner or Scanner()
    rng = np.random.default_rng(seed)
    T_error = np.eye(4) if T_error is None else np.asarray(T_error, dtype=np.float64)
    geometry = RayScene(_parts_of(scene, _displacement(scene, displacement), instruments, cavity))
    rays = scanner.rays() @ T_patient_scanner[:3, :3].T
    seen = geometry.trace(T_patient_scanner[:3, 3], rays)
    cortex, nothing = seen.label == Seen.CORTEX, seen.label == Seen.NOTHING

    in_opening = transform_points(scene.craniotomy.T_craniotomy_patient, seen.material)[..., :2]
    albedo = scene.texture(in_opening)
    if cavity is not None:
        albedo = cavity.stain(albedo, in_opening)
    colored = ~(cortex | nothing)
    albedo[colored] = seen.color[colored]
    illumination = coaxial_lamp(rays, rng) if lighting is None else _lamp(lighting, scene, geometry, seen)
    rgb, specular = shade(
        albedo,
        seen.normal,
        rays,
        cortex | (seen.label == Seen.CAVITY),
        seen.label == Seen.INSTRUMENT,
        illumination,
        rng,
        speculars=scanner.speculars,
        color_noise=scanner.color_noise,
    )
    rgb[nothing] = 0

    lost = nothing | _lost(scanner, rays, seen.normal, specular, rng)
    noisy = seen.position + rays * rng.normal(0.0, scanner.range_noise_m, lost.shape)[..., None]
    noisy[lost] = np.nan
    points = transform_points(T_error @ invert_rigid(T_patient_tracker), noisy).astype(np.float32)
    current = np.where(cortex[..., None], seen.position, np.nan)
    scan = OrganisedScan(points, rgb, TRACKER_FRAME, stamp_ns)
    return SimulatedScan(scan, T_patient_tracker, seen.material, current, specular, seen.label, T_error)


def _parts_of(
    scene: SurgicalScene, move: Displacement, instruments: tuple[Instrument, ...], cavity: Cavity | None
) -> list[Part]:
    """List what the rays can meet, the cortex and its cavity moved."""
    vertices, faces = scene.cortex.vertices, scene.cortex.faces
    walls = []
    if cavity is not None:
        faces = faces[cavity.uncut_faces(scene.cortex, scene.craniotomy)]
        wall = cavity_wall(cavity, scene.cortex, scene.craniotomy)
        walls.append(Part(Seen.CAVITY, Surface(move(wall.surface.vertices), wall.surface.faces), color=wall.color))
    metal = [
        Part(Seen.INSTRUMENT, body.surface, color=np.full(body.surface.vertices.shape, body.reflectance))
        for body in instruments
    ]
    cortex = Part(Seen.CORTEX, Surface(move(vertices), faces), before=vertices)
    return [cortex, Part(Seen.SURROUND, scene.surround.surface, color=scene.surround.color), *walls, *metal]


def _displacement(scene: SurgicalScene, displacement: Displacement | NDArray[np.float64] | None) -> Displacement:
    """Return a function that moves points (n, 3); it refuses a displacement that is not finite or has another shape."""
    if displacement is None:
        return lambda points: points
    if callable(displacement):
        shift_at = displacement
    else:
        # What lies below the cortex goes with the vertex nearest to it.
        by_vertex = np.asarray(displacement, dtype=np.float64)[scene.vertex_ids]
        tree = cKDTree(scene.cortex.vertices)

        def shift_at(points: NDArray[np.float64]) -> NDArray[np.float64]:
            return by_vertex[tree.query(points)[1]]

    def move(points: NDArray[np.float64]) -> NDArray[np.float64]:
        shift = np.asarray(shift_at(points), dtype=np.float64)
        if shift.shape != points.shape or not np.isfinite(shift).all():
            raise InputError("displacement", f"shape {shift.shape} or not finite", "give three finite metres for each vertex")
        return points + shift

    return move


def _lamp(lighting: Lighting, scene: SurgicalScene, geometry: RayScene, seen: Traced) -> Illumination:
    """Lamp at each pixel: its cone, and shadows by a ray from every second pixel of every second row."""
    T_craniotomy_patient = scene.craniotomy.T_craniotomy_patient
    light = lighting.toward_lamp(T_craniotomy_patient[:3, :3].T)
    lamp = lighting.falloff(transform_points(T_craniotomy_patient, seen.position)[..., :2])
    if lighting.shadows:
        at = seen.position[::2, ::2] + _SHADOW_CLEARANCE_M * seen.normal[::2, ::2]
        known = np.isfinite(at).all(axis=-1)
        hidden = np.zeros(known.shape, dtype=bool)
        hidden[known] = geometry.hidden(at[known], light)
        lamp = lamp * soften(hidden, lamp.shape)
    return Illumination(light, lamp, lighting)


def _lost(
    scanner: Scanner,
    rays: NDArray[np.float64],
    normal: NDArray[np.float64],
    specular: NDArray[np.float32],
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    """Pixels without a range: grazing surfaces, random patches, glints."""
    shape = specular.shape
    facing = np.abs(np.einsum("hwc,hwc->hw", np.nan_to_num(normal), rays))
    lost = rng.uniform(size=shape) > np.clip((facing - 0.12) / 0.15, 0.0, 1.0)
    patches = smooth_noise(rng, shape, 0.008 * scanner.width)
    if scanner.dropout_fraction > 0:
        lost |= patches > np.quantile(patches, 1.0 - scanner.dropout_fraction)
    glare = cv2.dilate(specular, np.ones((3, 3), np.uint8))
    lost |= rng.uniform(size=shape) < np.clip((glare - 0.5) * 3.0, 0.0, 0.9)
    return np.asarray(lost)

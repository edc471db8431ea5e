"""A simulated laser range scanner: organised textured clouds with noise, dropouts and specular spots, and the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, transform_points, unit
from brainshift_ros.graph import TRACKER_FRAME
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.simulation.craniotomy import (
    Craniotomy,
    Surround,
    hull_height,
    make_surround,
    place_craniotomy,
)
from brainshift_ros.simulation.texture import CortexTexture, paint_texture, smooth_noise
from brainshift_ros.simulation.vessels import PaintedVessel, grow_vessels
from brainshift_ros.surface.queries import RayCaster, RayHits
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import vertex_normals

Displacement = Callable[[NDArray[np.float64]], NDArray[np.float64]]


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
class SurgicalScene:
    """Everything the scanner can see, before any shift, in the patient frame.

    Attributes
    ----------
    cortex
        Surface around the opening.
    vertex_ids
        Shape (V,), index of each vertex in the surface that the scene was made from.
    """

    cortex: Surface
    vertex_ids: NDArray[np.intp]
    craniotomy: Craniotomy
    surround: Surround
    texture: CortexTexture
    vessels: tuple[PaintedVessel, ...]


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
    """

    scan: OrganisedScan
    T_patient_tracker: NDArray[np.float64]
    material: NDArray[np.float64]
    current: NDArray[np.float64]
    specular: NDArray[np.float32]


def make_scene(cortex: Surface, center: NDArray[np.float64], diameter_m: float, seed: int) -> SurgicalScene:
    """Open a craniotomy over `cortex`, paint the brain and cover the rest.

    Parameters
    ----------
    cortex
        The true surface, patient frame, metres; edges of 1 to 2 mm or finer show gyri.
    center, diameter_m
        Where and how wide the opening is, metres.
    seed
        Decides vessels, mottling, edge and drape.
    """
    rng = np.random.default_rng(seed)
    craniotomy = place_craniotomy(cortex, center, diameter_m)
    local = transform_points(craniotomy.T_craniotomy_patient, cortex.vertices)
    keep = (np.hypot(local[:, 0], local[:, 1]) < 1.7 * craniotomy.radius_m) & (local[:, 2] > -0.045)
    faces = cortex.faces[keep[cortex.faces].all(axis=1)]
    ids = np.unique(faces)
    if len(ids) < 100:
        raise InputError("cortex", f"only {len(ids)} vertices around the craniotomy", "give a finer surface or another centre")
    renumber = np.full(len(cortex.vertices), -1, dtype=np.int32)
    renumber[ids] = np.arange(len(ids))
    half_width = 1.4 * craniotomy.radius_m
    height, hull = hull_height(craniotomy, cortex, half_width)
    vessels = grow_vessels(craniotomy.radius_m, rng)
    texture = paint_texture(vessels, hull - height, half_width, rng)
    return SurgicalScene(
        cortex=Surface(cortex.vertices[ids], renumber[faces]),
        vertex_ids=ids.astype(np.intp),
        craniotomy=craniotomy,
        surround=make_surround(craniotomy, cortex, rng),
        texture=texture,
        vessels=vessels,
    )


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


def _interpolate(
    values: NDArray[np.float64], faces: NDArray[np.int32], hits: RayHits, first_face: int, where: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Interpolate vertex values at the hit points of the pixels `where`, shape (k, ...); `faces` begin at `first_face`."""
    return np.einsum("kc,kcd->kd", hits.barycentric[where], values[faces[hits.face[where] - first_face]])


def take_scan(
    scene: SurgicalScene,
    T_patient_tracker: NDArray[np.float64],
    T_patient_scanner: NDArray[np.float64],
    *,
    seed: int,
    displacement: Displacement | NDArray[np.float64] | None = None,
    scanner: Scanner | None = None,
    stamp_ns: int = 0,
) -> SimulatedScan:
    """Scan the scene once.

    Parameters
    ----------
    scene
        From :func:`make_scene`.
    T_patient_tracker
        4x4, tracker to patient; the scan is delivered in tracker space.
    T_patient_scanner
        4x4, scanner (z forward) to patient, as :func:`scanner_pose` gives it.
    seed
        Decides noise, dropouts, glints and lighting of this scan.
    displacement
        Shift of the cortex: a function of points (n, 3) in metres, or an array (V, 3) over the vertices of the surface
        that the scene was made from. None: no shift.
    scanner
        Optics; :class:`Scanner` by default.
    stamp_ns
        Time of acquisition.
    """
    scanner = scanner or Scanner()
    rng = np.random.default_rng(seed)
    undeformed = scene.cortex.vertices
    if displacement is None:
        shift = np.zeros_like(undeformed)
    elif callable(displacement):
        shift = np.asarray(displacement(undeformed), dtype=np.float64)
    else:
        shift = np.asarray(displacement, dtype=np.float64)[scene.vertex_ids]
    if shift.shape != undeformed.shape or not np.isfinite(shift).all():
        raise InputError("displacement", f"shape {shift.shape} or not finite", "give three finite metres for each vertex")
    displaced = undeformed + shift

    origin = T_patient_scanner[:3, 3]
    rays = scanner.rays() @ T_patient_scanner[:3, :3].T
    surround, cortex_faces = scene.surround.surface, len(scene.cortex.faces)
    everything = Surface(
        np.vstack([displaced, surround.vertices]), np.vstack([scene.cortex.faces, surround.faces + len(displaced)])
    )
    hits = RayCaster(everything).cast(origin, rays)
    shape = rays.shape[:2]
    on_surround = hits.face >= cortex_faces
    on_cortex = (hits.face >= 0) & ~on_surround
    position, normal, material = (np.full((*shape, 3), np.nan) for _ in range(3))
    for where, vertices, faces, first_face in (
        (on_cortex, displaced, scene.cortex.faces, 0),
        (on_surround, surround.vertices, surround.faces, cortex_faces),
    ):
        position[where] = _interpolate(vertices, faces, hits, first_face, where)
        normal[where] = unit(_interpolate(vertex_normals(vertices, faces), faces, hits, first_face, where))
    material[on_cortex] = _interpolate(undeformed, scene.cortex.faces, hits, 0, on_cortex)

    albedo = scene.texture(transform_points(scene.craniotomy.T_craniotomy_patient, material)[..., :2])
    albedo[on_surround] = _interpolate(scene.surround.color, surround.faces, hits, cortex_faces, on_surround)
    rgb, specular = _shade(albedo, normal, rays, scanner, on_cortex, rng)
    rgb[~(on_cortex | on_surround)] = 0

    facing = np.abs(np.einsum("hwc,hwc->hw", np.nan_to_num(normal), rays))
    lost = ~(on_cortex | on_surround) | (rng.uniform(size=shape) > np.clip((facing - 0.12) / 0.15, 0.0, 1.0))
    patches = smooth_noise(rng, shape, 0.008 * scanner.width)
    if scanner.dropout_fraction > 0:
        lost |= patches > np.quantile(patches, 1.0 - scanner.dropout_fraction)
    glare = cv2.dilate(specular, np.ones((3, 3), np.uint8))
    lost |= rng.uniform(size=shape) < np.clip((glare - 0.5) * 3.0, 0.0, 0.9)
    noisy = position + rays * rng.normal(0.0, scanner.range_noise_m, shape)[..., None]
    noisy[lost] = np.nan
    points = transform_points(invert_rigid(T_patient_tracker), noisy).astype(np.float32)
    current = np.where(on_cortex[..., None], position, np.nan)
    scan = OrganisedScan(points, rgb, TRACKER_FRAME, stamp_ns)
    return SimulatedScan(scan, T_patient_tracker, material, current, specular)


def _shade(
    albedo: NDArray[np.float32],
    normal: NDArray[np.float64],
    rays: NDArray[np.float64],
    scanner: Scanner,
    wet: NDArray[np.bool_],
    rng: np.random.Generator,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Diffuse light from beside the scanner, Blinn-Phong glints of wet tissue, vignetting, exposure, colour noise."""
    shape = albedo.shape[:2]
    n = np.nan_to_num(normal)
    light = unit(-rays + 0.25 * unit(rng.normal(size=3)))
    diffuse = 0.35 + 0.65 * np.clip(np.einsum("hwc,hwc->hw", n, light), 0.0, 1.0)
    specular = np.zeros(shape, dtype=np.float32)
    if scanner.speculars:
        # The film of fluid is not as smooth as the surface mesh: its ripples break the glint into spots.
        ripple = np.stack([smooth_noise(rng, shape, 0.006 * scanner.width) for _ in range(3)], axis=-1)
        wet_normal = unit(np.where(wet[..., None], n + 0.10 * ripple, [0.0, 0.0, 1.0]))
        half = unit(light - rays)
        glint = np.clip(np.einsum("hwc,hwc->hw", wet_normal, half), 0.0, 1.0) ** 400
        specular = np.where(wet, np.clip(2.2 * glint - 0.6, 0.0, 1.0), 0.0).astype(np.float32)
    v, u = np.meshgrid(np.linspace(-1, 1, shape[0]), np.linspace(-1, 1, shape[1]), indexing="ij")
    vignette = 1.0 - 0.18 * (u**2 + v**2)
    exposure = rng.uniform(0.92, 1.08) * rng.uniform(0.97, 1.03, 3)
    color = albedo * (diffuse * vignette)[..., None] * exposure + specular[..., None]
    color = cv2.GaussianBlur(color.astype(np.float32), (0, 0), 0.6 * scanner.width / 640)
    color += rng.normal(0.0, scanner.color_noise, color.shape)
    return (255.0 * np.clip(color, 0.0, 1.0)).astype(np.uint8), specular

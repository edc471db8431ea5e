"""A resection cavity: a bowl of raw, bloody tissue where the cortex was taken out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.simulation.craniotomy import Craniotomy
from brainshift_ros.simulation.texture import smooth_noise
from brainshift_ros.surface.queries import RayCaster
from brainshift_ros.surface.surface import Surface

_RINGS, _SECTORS = 56, 288
_FLANGE_M, _FLANGE_DEPTH_M = 1.5e-3, 0.4e-3  # the wall runs on beneath the cut cortex, so that no ray slips between
_DEEPEST_RIM_M = 4e-3  # a sulcus that crosses the rim is cut open no deeper
_TISSUE, _BLOOD = np.array([0.70, 0.45, 0.36]), np.array([0.38, 0.05, 0.05])
_NOISE_PX = 128


@dataclass(frozen=True)
class Cavity:
    """Where tissue was taken out, in the craniotomy's coordinates before any shift: the cavity moves with the tissue.

    Attributes
    ----------
    center_m
        Craniotomy xy of its middle, metres.
    radius_m, depth_m
        Mean radius of the rim, and depth of the bowl below it, metres.
    seed
        Decides the rim's outline, the wall's lumps and the blood.
    """

    center_m: tuple[float, float]
    radius_m: float
    depth_m: float
    seed: int = 0

    def rim_m(self, angle: NDArray[np.float64]) -> NDArray[np.float64]:
        """Radius of the rim at angles about the middle, metres."""
        rng = np.random.default_rng(self.seed)
        waves = [rng.normal(0.0, 0.10 / k) * np.cos(k * angle + rng.uniform(0.0, 2.0 * np.pi)) for k in range(2, 6)]
        return np.asarray(self.radius_m * (1.0 + np.clip(np.sum(waves, axis=0), -0.3, 0.3)))

    def beyond_rim_m(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance outside the rim along the radius, shape (...), negative inside, at craniotomy coordinates (..., 2)."""
        x, y = np.moveaxis(xy - np.asarray(self.center_m), -1, 0)
        return np.asarray(np.hypot(x, y) - self.rim_m(np.arctan2(y, x)))

    def uncut_faces(self, cortex: Surface, craniotomy: Craniotomy) -> NDArray[np.bool_]:
        """Faces of the cortex before the shift, shape (F,), that are still there: those with a corner outside the rim."""
        xy = transform_points(craniotomy.T_craniotomy_patient, cortex.vertices)[:, :2]
        return np.asarray((self.beyond_rim_m(xy) >= 0.0)[cortex.faces].any(axis=1))

    def stain(self, albedo: NDArray[np.float32], xy: NDArray[np.float64]) -> NDArray[np.float32]:
        """Stain the cortex beside the rim with blood: reflectance (H, W, 3) seen at craniotomy coordinates (H, W, 2)."""
        beyond = self.beyond_rim_m(xy)
        x, y = np.moveaxis(xy - np.asarray(self.center_m), -1, 0)
        rng = np.random.default_rng([self.seed, 1])
        waves = [rng.normal(0.0, 0.6) * np.cos(k * np.arctan2(y, x) + rng.uniform(0.0, 2.0 * np.pi)) for k in range(1, 9)]
        reach = 0.8e-3 * np.exp(np.clip(np.sum(waves, axis=0), -1.5, 1.2))
        cover = np.nan_to_num(0.85 * np.clip(1.5 - np.maximum(beyond, 0.0) / reach, 0.0, 1.0))
        return np.asarray(albedo + cover[..., None] * (_BLOOD - albedo), dtype=np.float32)


@dataclass(frozen=True)
class CavityWall:
    """The bowl before any shift, patient frame; `color` (V, 3) is linear RGB reflectance."""

    surface: Surface
    color: NDArray[np.float64]


def cavity_wall(cavity: Cavity, cortex: Surface, craniotomy: Craniotomy) -> CavityWall:
    """Build the bowl below the cortex: its rim lies on the surface, its wall is steep, its floor lumpy and under blood.

    Parameters
    ----------
    cavity
        Where, how wide and deep.
    cortex
        Before the shift, patient frame.
    craniotomy
        Whose coordinates `cavity` uses.
    """
    rng = np.random.default_rng([cavity.seed, 2])
    angle = np.linspace(0.0, 2.0 * np.pi, _SECTORS, endpoint=False)
    rim = cavity.rim_m(angle)
    toward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    center = np.asarray(cavity.center_m)
    local = Surface(transform_points(craniotomy.T_craniotomy_patient, cortex.vertices), cortex.faces)
    edge = center + rim[:, None] * toward
    edge_z, flange_z = _heights(local, np.stack([edge, edge + _FLANGE_M * toward]))

    share = np.linspace(0.0, 1.0, _RINGS)[1:, None]
    xy = center + share[..., None] * (rim[:, None] * toward)
    lump = _at(smooth_noise(rng, (_NOISE_PX, _NOISE_PX), 10.0), xy - center, cavity.radius_m)
    z = edge_z.mean() + share**2 * (edge_z - edge_z.mean()) - cavity.depth_m * (1.0 - share**4)
    z += 0.06 * cavity.depth_m * lump * (1.0 - share**6)
    bottom = np.append(center, edge_z.mean() - cavity.depth_m)
    flange = np.column_stack([edge + _FLANGE_M * toward, np.minimum(flange_z, edge_z) - _FLANGE_DEPTH_M])
    vertices = np.concatenate([bottom[None], np.concatenate([xy, z[..., None]], axis=-1).reshape(-1, 3), flange])

    blood = _at(smooth_noise(rng, (_NOISE_PX, _NOISE_PX), 7.0), xy - center, cavity.radius_m)
    blood += 0.6 * _at(smooth_noise(rng, (_NOISE_PX, _NOISE_PX), 2.5), xy - center, cavity.radius_m)
    pool = np.clip((0.55 - share) / 0.15, 0.0, 1.0)
    cover = np.clip(np.maximum(0.55 + 0.30 * blood, pool), 0.0, 1.0)
    color = _TISSUE + cover[..., None] * (_BLOOD - _TISSUE)
    colors = np.concatenate([_BLOOD[None], color.reshape(-1, 3), np.tile(_BLOOD, (_SECTORS, 1))])

    i, j = np.meshgrid(np.arange(_RINGS - 1), np.arange(_SECTORS), indexing="ij")
    a, b = 1 + i * _SECTORS + j, 1 + i * _SECTORS + (j + 1) % _SECTORS
    rings = np.concatenate([np.stack([a, a + _SECTORS, b + _SECTORS], -1), np.stack([a, b + _SECTORS, b], -1)])
    fan = np.stack([np.zeros(_SECTORS, dtype=int), a[0], b[0]], axis=-1)
    faces = np.concatenate([fan, rings.reshape(-1, 3)]).astype(np.int32)
    return CavityWall(Surface(transform_points(invert_rigid(craniotomy.T_craniotomy_patient), vertices), faces), colors)


def _heights(local: Surface, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the cortex at craniotomy coordinates (..., 2); clefts and holes are taken as shallow."""
    top = float(local.vertices[:, 2].max()) + 0.01
    distance = (
        RayCaster(local).cast(np.concatenate([xy, np.full((*xy.shape[:-1], 1), top)], axis=-1), (0.0, 0.0, -1.0)).distance
    )
    height = np.where(np.isfinite(distance), top - distance, -np.inf)
    return np.asarray(np.maximum(height, np.median(height) - _DEEPEST_RIM_M))


def _at(noise: NDArray[np.float32], offset: NDArray[np.float64], radius_m: float) -> NDArray[np.float64]:
    """Sample a square picture of noise, four radii wide, at offsets (..., 2) from its middle."""
    index = (0.5 * (_NOISE_PX - 1) + offset * (_NOISE_PX / (4.0 * radius_m))).astype(np.float32)
    sampled = cv2.remap(noise, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(sampled, dtype=np.float64)

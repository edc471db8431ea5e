"""The opening in the skull: its own coordinates, and the dura, bone and drape around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import tangent_frame, transform_points, unit
from brainshift_ros.surface.queries import RayCaster
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import vertex_normals

_HULL_SPACING_M = 1.5e-3
_HULL_CLOSING_M = 15e-3
_HULL_LOWEST_M = -25e-3


@dataclass(frozen=True)
class Craniotomy:
    """A round craniotomy.

    Attributes
    ----------
    T_craniotomy_patient
        4x4; the origin lies on the cortex in the middle of the opening, z points out of the head.
    radius_m
        Radius of the opening in the craniotomy's xy plane.
    """

    T_craniotomy_patient: NDArray[np.float64]
    radius_m: float

    @property
    def axis(self) -> NDArray[np.float64]:
        """Unit vector out of the head, patient frame."""
        return self.T_craniotomy_patient[2, :3].copy()

    @property
    def center(self) -> NDArray[np.float64]:
        """Middle of the opening on the cortex, patient frame, metres."""
        T = self.T_craniotomy_patient
        return -T[:3, :3].T @ T[:3, 3]


def place_craniotomy(cortex: Surface, center: ArrayLike, diameter_m: float) -> Craniotomy:
    """Put a round craniotomy on the cortex point closest to `center`.

    Parameters
    ----------
    cortex
        Surface in the patient frame.
    center
        Shape (3,), metres, patient frame; within 40 mm of the surface.
    diameter_m
        Diameter of the opening, metres.

    Raises
    ------
    InputError
        When the centre is far from the cortex or the diameter is not 10 to 200 mm.
    """
    wanted = np.asarray(center, dtype=np.float64)
    if not 0.01 <= diameter_m <= 0.2:
        raise InputError("craniotomy diameter", f"{diameter_m} m is not 0.01 to 0.2 m", "give it in metres")
    distance = np.linalg.norm(cortex.vertices - wanted, axis=1)
    if not distance.min() < 0.04:
        raise InputError("craniotomy centre", f"{distance.min():.3f} m from the cortex", "give metres in the patient frame")
    near = distance < max(0.5 * diameter_m, distance.min() + 5e-3)
    normals = vertex_normals(cortex.vertices, cortex.faces)
    # Sulcal walls face each other, so that their normals cancel and the gyral crowns decide.
    axis = unit(normals[near].sum(axis=0))
    # The crown below the wanted centre: seen along the axis from outside.
    start = wanted + 0.1 * axis
    hit = float(RayCaster(cortex).cast(start, -axis).distance)
    origin = start - hit * axis if np.isfinite(hit) else cortex.vertices[np.argmin(distance)]
    T = np.eye(4)
    T[:3, :3] = tangent_frame(axis)
    T[:3, 3] = -T[:3, :3] @ origin
    return Craniotomy(T, 0.5 * diameter_m)


def hull_height(
    craniotomy: Craniotomy, cortex: Surface, half_width_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Height of the cortex and of its smooth hull (sulci bridged) over the craniotomy's xy plane.

    Returns
    -------
    height, hull
        Shape (n, n), metres, on the grid ``linspace(-half_width, half_width, n)``, first index y.
    """
    n = 2 * round(half_width_m / _HULL_SPACING_M) + 1
    axis = np.linspace(-half_width_m, half_width_m, n)
    x, y = np.meshgrid(axis, axis)
    local = Surface(transform_points(craniotomy.T_craniotomy_patient, cortex.vertices), cortex.faces)
    top = 0.1
    hit = RayCaster(local).cast(np.stack([x, y, np.full_like(x, top)], axis=-1), (0.0, 0.0, -1.0)).distance
    height = np.where(np.isfinite(hit), np.maximum(top - hit, _HULL_LOWEST_M), _HULL_LOWEST_M)
    size = 2 * round(0.5 * _HULL_CLOSING_M / _HULL_SPACING_M) + 1
    hull = ndimage.gaussian_filter(ndimage.grey_closing(height, size=(size, size)), 3e-3 / _HULL_SPACING_M)
    return height, hull


@dataclass(frozen=True)
class Surround:
    """What covers the brain outside the opening, in the patient frame.

    Attributes
    ----------
    surface
        Triangles of dura, bone edge and drape.
    color
        Shape (V, 3), linear RGB reflectance 0 to 1.
    """

    surface: Surface
    color: NDArray[np.float64]


def make_surround(craniotomy: Craniotomy, cortex: Surface, rng: np.random.Generator) -> Surround:
    """Dura cuff just above the cortex, bone wall 6 mm high, then a folded drape; an irregular edge."""
    outer_m = craniotomy.radius_m + 45e-3
    _, hull = hull_height(craniotomy, cortex, outer_m)
    angles = np.linspace(0.0, 2 * np.pi, 361)[:-1]
    beyond = np.r_[np.linspace(0.0, 12e-3, 25), np.linspace(13e-3, 45e-3, 33)]
    waves = [rng.normal(0.0, 0.9e-3 / k) * np.cos(k * angles + rng.uniform(0, 2 * np.pi)) for k in range(2, 7)]
    wobble = np.sum(waves, axis=0)
    r = craniotomy.radius_m + wobble[:, None] * np.exp(-beyond / 15e-3) + beyond
    x, y = r * np.cos(angles[:, None]), r * np.sin(angles[:, None])
    index = np.stack([(y + outer_m) / _HULL_SPACING_M, (x + outer_m) / _HULL_SPACING_M])
    base = ndimage.map_coordinates(hull, index, order=1, mode="nearest")
    # Heights over the hull: dura cuff, bone wall, scalp edge, drape.
    profile = np.interp(
        beyond, [0.0, 1e-3, 4e-3, 5.5e-3, 9e-3, 12e-3, 45e-3], [0.3e-3, 1e-3, 1.5e-3, 6e-3, 6.5e-3, 10e-3, 11e-3]
    )
    folds = sum(
        rng.normal(0.0, 1.2e-3) * np.sin(2 * np.pi * (x * np.cos(a) + y * np.sin(a)) / wavelength + rng.uniform(0, 6.28))
        for a, wavelength in zip(rng.uniform(0, np.pi, 6), rng.uniform(9e-3, 40e-3, 6), strict=True)
    )
    z = base + profile + folds * np.clip((beyond - 10e-3) / 5e-3, 0.0, 1.0)
    rows, columns = len(angles), len(beyond)
    i, j = np.meshgrid(np.arange(rows), np.arange(columns - 1), indexing="ij")
    a, b = i * columns + j, (i + 1) % rows * columns + j
    faces = np.concatenate([np.stack([a, a + 1, b + 1], -1).reshape(-1, 3), np.stack([a, b + 1, b], -1).reshape(-1, 3)])
    dura, bone, scalp, drape = (0.66, 0.50, 0.44), (0.72, 0.62, 0.46), (0.45, 0.13, 0.11), (0.12, 0.33, 0.36)
    stops = [0.0, 4.5e-3, 5.5e-3, 8.5e-3, 9.5e-3, 11.5e-3, 12.5e-3]
    palette = np.array([dura, dura, bone, bone, scalp, scalp, drape])
    color = np.stack([np.interp(beyond, stops, palette[:, c]) for c in range(3)], axis=-1)
    stain = 1.0 + 0.12 * ndimage.gaussian_filter(rng.normal(size=(rows, columns)), 2.0, mode="wrap") * 6.0
    vertices = transform_points(np.linalg.inv(craniotomy.T_craniotomy_patient), np.stack([x, y, z], -1).reshape(-1, 3))
    return Surround(
        Surface(vertices, faces.astype(np.int32)),
        np.clip(color[None] * np.clip(stain, 0.6, 1.4)[..., None], 0.0, 1.0).reshape(-1, 3),
    )

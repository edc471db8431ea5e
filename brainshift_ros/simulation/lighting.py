"""How the operating lamp lights the field: direction, colour, unevenness, cast shadows, and glints of wet tissue and metal."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import unit
from brainshift_ros.simulation.texture import smooth_noise

_WAVELENGTHS_M = np.array([610e-9, 545e-9, 465e-9])  # where the camera's red, green and blue are most sensitive
_SECOND_RADIATION_M_K = 1.438777e-2
_WHITE_BALANCE_K = 5000.0
_METAL_GLOSS, _BRUSHED_GLOSS = 60.0, 6.0
_PENUMBRA = 0.012  # of the picture's width: an operating lamp is wide, its shadows are soft
_VIGNETTING = 0.18


@dataclass(frozen=True)
class Lighting:
    """The operating lamp, the room's light, and how wet the tissue is.

    Attributes
    ----------
    direction
        Towards the lamp, in the craniotomy's coordinates (z out of the head); any length. The lamp is far away.
    exposure
        Factor on all channels.
    temperature_k
        Colour temperature, kelvin; the camera is balanced for 5000 K.
    ambient
        Share of the light that comes from all sides, 0 to 1.
    gloss
        Blinn-Phong exponent of the wet tissue: higher is smaller and sharper glints.
    spot_center_m, spot_radius_m
        Middle (craniotomy xy, metres) and Gaussian radius of the lamp's cone; an infinite radius lights evenly.
    shadows
        Whether bone, instruments and cavity walls keep the lamp's light off what lies behind them.
    """

    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    exposure: float = 1.0
    temperature_k: float = _WHITE_BALANCE_K
    ambient: float = 0.35
    gloss: float = 400.0
    spot_center_m: tuple[float, float] = (0.0, 0.0)
    spot_radius_m: float = float("inf")
    shadows: bool = True

    def gain(self) -> NDArray[np.float64]:
        """Factors on red, green and blue: exposure, and the black body's colour (Planck) with green kept."""
        exponent = _SECOND_RADIATION_M_K / _WAVELENGTHS_M
        relative = np.expm1(exponent / _WHITE_BALANCE_K) / np.expm1(exponent / self.temperature_k)
        return np.asarray(self.exposure * relative / relative[1])

    def toward_lamp(self, R_patient_craniotomy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unit vector towards the lamp, patient frame."""
        return R_patient_craniotomy @ unit(self.direction)

    def falloff(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Brightness of the lamp's cone, 0 to 1, at craniotomy coordinates (..., 2); 1 where they are NaN."""
        if not np.isfinite(self.spot_radius_m):
            return np.ones(xy.shape[:-1])
        squared = np.sum((xy - self.spot_center_m) ** 2, axis=-1)
        return np.where(np.isfinite(squared), np.exp(-0.5 * squared / self.spot_radius_m**2), 1.0)


@dataclass(frozen=True)
class Illumination:
    """What reaches each pixel.

    Attributes
    ----------
    light
        Shape (3,) or (H, W, 3), unit vectors towards the lamp.
    lamp
        Shape (H, W), the lamp's strength, 0 in full shadow to 1.
    lighting
        None: a lamp beside the scanner, drawn from the scan's seed.
    """

    light: NDArray[np.float64]
    lamp: NDArray[np.float64]
    lighting: Lighting | None


def coaxial_lamp(rays: NDArray[np.float64], rng: np.random.Generator) -> Illumination:
    """Light that comes from beside the scanner, in a random direction."""
    return Illumination(unit(-rays + 0.25 * unit(rng.normal(size=3))), np.ones(rays.shape[:2]), None)


def soften(shadow: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Share of the lamp that reaches each pixel, shape `shape`, from a coarser picture of hard shadows."""
    lit = cv2.resize(1.0 - shadow.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.GaussianBlur(lit, (0, 0), _PENUMBRA * shape[1]), dtype=np.float64)


def shade(
    albedo: NDArray[np.float32],
    normal: NDArray[np.float64],
    rays: NDArray[np.float64],
    wet: NDArray[np.bool_],
    metal: NDArray[np.bool_],
    illumination: Illumination,
    rng: np.random.Generator,
    *,
    speculars: bool,
    color_noise: float,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Diffuse light, Blinn-Phong glints of wet tissue and metal, vignetting, exposure, blur and colour noise.

    Parameters
    ----------
    albedo
        Shape (H, W, 3), linear RGB reflectance.
    normal, rays
        Shape (H, W, 3), unit vectors in one frame; normals are NaN where nothing was hit.
    wet, metal
        Shape (H, W): tissue under a film of fluid; bare metal.
    illumination
        What reaches each pixel.
    rng
        Decides the fluid's ripples and the noise.
    speculars
        Whether wet tissue and metal glint.
    color_noise
        Standard deviation, 0 to 1.

    Returns
    -------
    rgb, specular
        Shape (H, W, 3) uint8, and the glints' strength (H, W), 0 to 1.
    """
    shape = albedo.shape[:2]
    width = shape[1]
    lighting = illumination.lighting or Lighting()
    light = np.broadcast_to(illumination.light, rays.shape)
    n = np.nan_to_num(normal)
    lambert = np.clip(np.einsum("hwc,hwc->hw", n, light), 0.0, 1.0)
    diffuse = lighting.ambient + (1.0 - lighting.ambient) * lambert * illumination.lamp
    specular = np.zeros(shape, dtype=np.float32)
    if speculars:
        # The film of fluid is not as smooth as the surface mesh: its ripples break the glint into spots.
        ripple = np.stack([smooth_noise(rng, shape, 0.006 * width) for _ in range(3)], axis=-1)
        wet_normal = unit(np.where(wet[..., None], n + 0.10 * ripple, [0.0, 0.0, 1.0]))
        half = unit(light - rays)
        glint = np.clip(np.einsum("hwc,hwc->hw", wet_normal, half), 0.0, 1.0) ** lighting.gloss
        strength = np.where(wet, np.clip(2.2 * glint - 0.6, 0.0, 1.0), 0.0)
        facing = np.abs(np.einsum("hwc,hwc->hw", n, half))
        polished = facing**_METAL_GLOSS + 0.35 * facing**_BRUSHED_GLOSS
        strength = np.where(metal, np.minimum(polished, 1.0), strength) * illumination.lamp
        specular = strength.astype(np.float32)
    v, u = np.meshgrid(np.linspace(-1, 1, shape[0]), np.linspace(-1, 1, width), indexing="ij")
    vignette = 1.0 - _VIGNETTING * (u**2 + v**2)
    drawn = illumination.lighting is None
    gain = rng.uniform(0.92, 1.08) * rng.uniform(0.97, 1.03, 3) if drawn else lighting.gain()
    color = albedo * (diffuse * vignette)[..., None] * gain + specular[..., None]
    color = cv2.GaussianBlur(color.astype(np.float32), (0, 0), 0.6 * width / 640)
    color += rng.normal(0.0, color_noise, color.shape)
    return (255.0 * np.clip(color, 0.0, 1.0)).astype(np.uint8), specular

"""Blood that has run over the cortex: an opaque film that hides the vessels below it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from brainshift_ros.simulation.scene import SurgicalScene
from brainshift_ros.simulation.texture import smooth_noise

_BLOOD = np.array([0.42, 0.05, 0.05], dtype=np.float32)
_POOL_M = 7e-3  # correlation length of the pools' outline
_SOFTNESS = 0.15  # of the film's edge, in standard deviations of the field that bounds it


@dataclass(frozen=True)
class BloodFilm:
    """Opaque pools that together cover a share of the opening, 0 to 1; `seed` says where."""

    share: float
    seed: int

    def over(self, scene: SurgicalScene) -> SurgicalScene:
        """Return the scene with the film on its cortex, on which it moves."""
        texture = scene.texture
        shape = texture.image.shape[:2]
        field = smooth_noise(np.random.default_rng(self.seed), (shape[0], shape[1]), _POOL_M / texture.pixel_m)
        offset = np.abs(np.arange(shape[0]) - 0.5 * (shape[0] - 1)) * texture.pixel_m
        in_opening = np.hypot(offset[:, None], offset) < scene.craniotomy.radius_m
        edge = np.quantile(field[in_opening], 1.0 - self.share) if self.share > 0 else np.inf
        cover = np.clip((field - edge) / _SOFTNESS + 0.5, 0.0, 1.0)[..., None]
        return replace(
            scene, texture=replace(texture, image=(texture.image + cover * (_BLOOD - texture.image)).astype(np.float32))
        )

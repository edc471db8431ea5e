"""An organised, textured laser range scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class OrganisedScan:
    """A scan whose points lie on the pixel grid of its texture image.

    Attributes
    ----------
    points
        Shape (H, W, 3), float32, metres, in `frame_id`; NaN where nothing was seen.
    rgb
        Shape (H, W, 3), uint8.
    frame_id
        The frame of `points`.
    stamp_ns
        Time of acquisition in nanoseconds.
    """

    points: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    frame_id: str
    stamp_ns: int

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Shape (H, W): where all three coordinates are finite."""
        finite = np.isfinite(self.points)
        return np.asarray(finite[..., 0] & finite[..., 1] & finite[..., 2])  # several times as fast as all(axis=-1)

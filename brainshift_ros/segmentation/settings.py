"""How much work the segmentation puts into its registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class SegmentationSettings:
    """Resolution and effort of the registration; the defaults are those that `brainshift experiment registration` marks.

    Attributes
    ----------
    spacing_mm
        Voxel size of the images that are registered, and of the displacement that is kept.
    iterations
        Of the non-rigid registration at 4, 2 and 1 times `spacing_mm`.
    metric
        Of the non-rigid registration: ``wncc``, local correlation, or ``nmi``, normalised mutual information.
    margin_mm
        The metric counts up to this distance from the template's brain. The template has no skull, the patient may.
    threads
        Of the registration.
    seed
        Of its random starts. Threads add up in an order of their own, so equal seeds give nearly equal maps.
    timeout_s
        Wall time after which a stage of the registration is given up.
    """

    spacing_mm: float = 2.0
    iterations: tuple[int, int, int] = (100, 50, 20)
    metric: Literal["wncc", "nmi"] = "wncc"
    margin_mm: float = 4.0
    threads: int = 2
    seed: int = 1
    timeout_s: float = 600.0

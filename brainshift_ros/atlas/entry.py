"""One entry (column) of the atlas, and the groups whose weights share a sum limit."""

from __future__ import annotations

from dataclasses import dataclass

#: Names of the groups: columns that were solved before surgery, and those that a blade appends during it.
PREOPERATIVE, RETRACTION = "preoperative", "retraction"


@dataclass(frozen=True)
class AtlasEntry:
    """Parameters of one forward solution.

    Attributes
    ----------
    mechanism
        ``gravity``, ``mannitol``, ``swelling``, ``retraction`` or ``release``.
    gravity_direction
        Unit vector along which gravity pulls, patient frame.
    fluid_level
        Height of the fluid surface along "up" (against gravity), as a fraction of the head's extent, 0 at the lowest
        and 1 at the highest node; tissue above it has lost its buoyancy. 1 where gravity does not act.
    drug_level
        1-based level of the drug or of the swelling pressure, 0 where none acts.
    resected
        Whether the tumour's elements are removed.
    intensity
        What the level stands for, 0 to 1: from the lowest to the highest capillary permeability of table 1 for mannitol, a
        fraction of the largest capillary pressure for swelling; 0 where neither acts.
    """

    mechanism: str
    gravity_direction: tuple[float, float, float]
    fluid_level: float
    drug_level: int
    resected: bool
    intensity: float = 0.0


@dataclass(frozen=True)
class WeightGroup:
    """Columns whose weights sum to at most `sum_limit`: (3.9) for one group, (6.3) for two. It may have no columns yet."""

    name: str
    columns: tuple[int, ...]
    sum_limit: float = 1.0

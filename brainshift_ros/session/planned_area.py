"""Where a scan is to be looked for: the craniotomy that the scene plans."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from brainshift_ros.registration.search import SearchArea
from brainshift_ros.units import mm_to_m


def planned_area(path: str | Path) -> SearchArea | None:
    """Area of the craniotomy of a scene file; None where it plans none.

    Raises
    ------
    InputError
        As :func:`brainshift_ros.atlas.scene.read_scene`.
    """
    # Imported only where there is a scene: it brings the mechanics along, for which a restarted node should not wait.
    from brainshift_ros.atlas.scene import read_scene

    craniotomy = read_scene(path).craniotomy
    if craniotomy is None:
        return None
    return SearchArea(np.asarray(mm_to_m(craniotomy.center_mm)), float(mm_to_m(craniotomy.diameter_mm)) / 2.0)

"""From a scene to the entries of its atlas: which forward problems are solved, in which order."""

from __future__ import annotations

import numpy as np

from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.errors import InputError

#: Range of fluid levels, as fractions of the head's extent along up; the thesis designates its levels by hand. On the MNI152
#: brain, supine, the lowest lets the uppermost cortex sag by about 12 mm and the highest by about 5 mm, the range that
#: surgery shows. A scene with one level uses the lowest: weights from 0 to 1 (3.9) reach all smaller shifts, none larger.
LOWEST_FLUID_LEVEL = 0.4
HIGHEST_FLUID_LEVEL = 0.8


def fluid_levels(count: int) -> tuple[float, ...]:
    """Evenly spaced fluid levels from the lowest up."""
    return tuple(float(level) for level in np.linspace(LOWEST_FLUID_LEVEL, HIGHEST_FLUID_LEVEL, count))


def refuse_unmodelled(scene: Scene, source: object) -> None:
    """Refuse what this version does not model.

    Raises
    ------
    InputError
        Every key of the scene that is not modelled is named.
    """
    absent = {
        "mannitol": scene.mannitol is not None,
        "swelling": scene.swelling is not None,
        "model.element: P2": scene.model.element == "P2",
        "model.time: transient": scene.model.time != "steady",
        "model.skull: contact": scene.model.skull == "contact",
        "tolerance_mm": scene.tolerance_mm is not None,
    }
    asked = [key for key, is_asked in absent.items() if is_asked]
    if asked:
        remedy = "remove these keys: gravity with element P1, time steady and skull free_cap is modelled"
        raise InputError(source, f"asks for {', '.join(asked)}, which this version does not model", remedy)
    if scene.gravity is None:
        raise InputError(source, "names no mechanism", "give gravity")


def entries_of(scene: Scene, source: object = "scene") -> tuple[AtlasEntry, ...]:
    """Entries of a scene: resection state by state, orientation by orientation, level by level.

    Parameters
    ----------
    scene
        A validated scene.
    source
        Name of the scene for error messages.

    Raises
    ------
    InputError
        The scene asks for what this version does not model.
    """
    refuse_unmodelled(scene, source)
    assert scene.gravity is not None
    gravity = scene.gravity
    directions = directions_in_cone(gravity.direction, np.radians(gravity.cone_deg), gravity.orientations)
    states = {"none": (False,), "resected": (True,), "both": (False, True)}[scene.resection]
    return tuple(
        AtlasEntry(
            mechanism="gravity",
            gravity_direction=(float(direction[0]), float(direction[1]), float(direction[2])),
            fluid_level=level,
            drug_level=0,
            resected=resected,
        )
        for resected in states
        for direction in directions
        for level in fluid_levels(gravity.fluid_levels)
    )


def groups_of(entries: tuple[AtlasEntry, ...]) -> tuple[WeightGroup, ...]:
    """Weight groups of (3.9): the weights of all solutions computed before surgery share one sum limit."""
    return (WeightGroup("preoperative", tuple(range(len(entries)))),)

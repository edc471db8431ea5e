"""From a scene to the entries of its atlas: which forward problems are solved, in which order."""

from __future__ import annotations

import numpy as np

from brainshift_ros.atlas.entry import PREOPERATIVE, RETRACTION, AtlasEntry, WeightGroup
from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.atlas.scene import Scene, WeightSums, orientations_of
from brainshift_ros.errors import InputError

#: Range of fluid levels, as fractions of the head's extent along up; the thesis designates its levels by hand. On the MNI152
#: brain, supine, the lowest lets the uppermost cortex sag by about 12 mm and the highest by about 5 mm, the range that
#: surgery shows. A scene with one level uses the lowest: weights from 0 to 1 (3.9) reach all smaller shifts, none larger.
LOWEST_FLUID_LEVEL = 0.4
HIGHEST_FLUID_LEVEL = 0.8

#: Fluid level of entries on which gravity does not act: nothing lies above it, so nothing has lost its buoyancy.
SUBMERGED = 1.0


def fluid_levels(count: int) -> tuple[float, ...]:
    """Evenly spaced fluid levels from the lowest up."""
    return tuple(float(level) for level in np.linspace(LOWEST_FLUID_LEVEL, HIGHEST_FLUID_LEVEL, count))


def permeability_levels(count: int) -> tuple[float, ...]:
    """Evenly spaced from k_c1 (0) to k_c3 (1) of table 1; the highest alone if there is one, since weights reach down."""
    return tuple(float(level) for level in np.linspace(0.0, 1.0, count)) if count > 1 else (1.0,)


def pressure_levels(count: int) -> tuple[float, ...]:
    """Evenly spaced fractions of the largest pressure up to it, without zero."""
    return tuple(float(level) for level in np.arange(1, count + 1) / count)


def refuse_unmodelled(scene: Scene, source: object) -> None:
    """Refuse what this version does not model.

    Raises
    ------
    InputError
        The scene leaves the choice of its model to a tolerance.
    """
    if scene.tolerance_mm is not None:
        problem = "asks for tolerance_mm, by which this version cannot choose a model"
        raise InputError(source, problem, "remove it, and say under `model` which element, time and skull to use")


def entries_of(scene: Scene, source: object = "scene") -> tuple[AtlasEntry, ...]:
    """Entries of a scene: by resection state, then orientation, then mechanism, then level.

    All entries of one orientation stand together, since they share their displacement boundary conditions (figure 5).

    Parameters
    ----------
    scene
        A validated scene.
    source
        Name of the scene for error messages.

    Raises
    ------
    InputError
        The scene asks for what this version does not model, or does not say how the head lies.
    """
    refuse_unmodelled(scene, source)
    head = orientations_of(scene, source)
    directions = directions_in_cone(head.direction, np.radians(head.cone_deg), head.orientations)
    states = {"none": (False,), "resected": (True,), "both": (False, True)}[scene.resection]
    mechanisms: list[tuple[str, float, int, float]] = []
    if scene.gravity is not None:
        mechanisms += [("gravity", level, 0, 0.0) for level in fluid_levels(scene.gravity.fluid_levels)]
    if scene.mannitol is not None:
        levels = permeability_levels(scene.mannitol.permeability_levels)
        mechanisms += [("mannitol", SUBMERGED, number, intensity) for number, intensity in enumerate(levels, start=1)]
    if scene.swelling is not None:
        levels = pressure_levels(scene.swelling.pressure_levels)
        mechanisms += [("swelling", SUBMERGED, number, intensity) for number, intensity in enumerate(levels, start=1)]
    return tuple(
        AtlasEntry(
            mechanism=mechanism,
            gravity_direction=(float(direction[0]), float(direction[1]), float(direction[2])),
            fluid_level=fluid_level,
            drug_level=drug_level,
            resected=resected,
            intensity=intensity,
        )
        for resected in states
        for direction in directions
        for mechanism, fluid_level, drug_level, intensity in mechanisms
    )


def groups_of(entries: tuple[AtlasEntry, ...], sums: WeightSums | None = None) -> tuple[WeightGroup, ...]:
    """Weight groups of (3.9) and (6.3): all solutions computed before surgery share one sum, those of a blade another.

    The second group has no columns before a blade is used; it holds the limit of those that are appended then.

    Parameters
    ----------
    entries
        Of the atlas.
    sums
        The limits; all 1 if None.
    """
    sums = sums or WeightSums()
    return (
        WeightGroup(PREOPERATIVE, tuple(range(len(entries))), sums.preoperative),
        WeightGroup(RETRACTION, (), sums.retraction),
    )

"""Chance in the simulated cases: scanner, lamp, cavity, instruments, tracker error and start of the registration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import invert_rigid, rigid, transform_points, unit
from brainshift_ros.simulation.cavity import Cavity
from brainshift_ros.simulation.craniotomy import Craniotomy
from brainshift_ros.simulation.instruments import Instrument, spatula, suction_tube
from brainshift_ros.simulation.lighting import Lighting
from brainshift_ros.simulation.scanner import Scanner, scanner_pose
from brainshift_ros.simulation.vessels import VesselStyle
from brainshift_ros.units import mm_to_m

_INSTRUMENT_M = 0.12
_BONE_M = 9e-3  # how far bone and scalp rise over the cortex


def draw_optics(scanner: Scanner, rng: np.random.Generator) -> Scanner:
    """Move the scanner nearer or farther (its angle of view stays); draw its share of lost points and its noise."""
    distance = rng.uniform(0.29, 0.35)
    return replace(
        scanner,
        distance_m=distance,
        view_m=scanner.view_m * distance / scanner.distance_m,
        dropout_fraction=rng.uniform(0.02, 0.10),
        range_noise_m=rng.uniform(0.2e-3, 0.4e-3),
    )


def draw_poses(
    craniotomy: Craniotomy, scanner: Scanner, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw T_patient_scanner of the first scan and of the later one: aimed by hand, and moved in between."""
    tilt, azimuth, roll = rng.uniform(0.0, 18.0), rng.uniform(0.0, 360.0), rng.uniform(0.0, 360.0)
    first = scanner_pose(craniotomy, scanner, tilt, azimuth, roll)
    tilt, azimuth, roll = rng.uniform(0.0, 18.0), azimuth + rng.uniform(-60.0, 60.0), roll + rng.uniform(-25.0, 25.0)
    later = scanner_pose(craniotomy, scanner, tilt, azimuth, roll)
    for pose in (first, later):
        pose[:3, 3] += pose[:3, :2] @ mm_to_m(rng.uniform(-4.0, 4.0, 2))
    return first, later


def draw_vessel_style(rng: np.random.Generator) -> VesselStyle:
    """Draw how vessels follow sulci and taper, and how dense the fine ones are."""
    return VesselStyle(sulcal_pull=rng.uniform(0.0, 1.0), end_width=rng.uniform(0.2, 0.5), fine_per_cm2=rng.uniform(0.5, 3.0))


def draw_lighting(craniotomy: Craniotomy, rng: np.random.Generator) -> Lighting:
    """Draw a lamp within 35 degrees of the opening's axis, even or with a cone, warm or cold."""
    tilt, azimuth = np.deg2rad(rng.uniform(5.0, 35.0)), rng.uniform(0.0, 2.0 * np.pi)
    uneven = rng.uniform() < 0.5
    spot = rng.uniform(-0.5, 0.5, 2) * craniotomy.radius_m
    return Lighting(
        direction=(np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)),
        exposure=rng.uniform(0.8, 1.25),
        temperature_k=rng.uniform(4000.0, 6500.0),
        ambient=rng.uniform(0.3, 0.5),
        gloss=rng.uniform(250.0, 600.0),
        spot_center_m=(float(spot[0]), float(spot[1])),
        spot_radius_m=rng.uniform(30e-3, 60e-3) if uneven else float("inf"),
    )


def draw_cavity(craniotomy: Craniotomy, rng: np.random.Generator) -> Cavity:
    """Draw a hole of a quarter to two fifths of the opening's width, anywhere in its middle half."""
    radius = rng.uniform(0.22, 0.40) * craniotomy.radius_m
    away, azimuth = rng.uniform(0.0, 0.45) * craniotomy.radius_m, rng.uniform(0.0, 2.0 * np.pi)
    return Cavity(
        center_m=(away * np.cos(azimuth), away * np.sin(azimuth)),
        radius_m=radius,
        depth_m=rng.uniform(0.8, 1.6) * radius,
        seed=int(rng.integers(2**31)),
    )


def draw_instruments(
    craniotomy: Craniotomy,
    cortex: NDArray[np.float64],
    shift: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None,
    cavity: Cavity | None,
    rng: np.random.Generator,
) -> tuple[Instrument, ...]:
    """Draw a suction tube, a spatula, or both, held over the cortex (n, 3), craniotomy frame, or into the cavity."""
    T_patient_craniotomy = invert_rigid(craniotomy.T_craniotomy_patient)
    kinds = (("tube",), ("spatula",), ("tube", "spatula"))[int(rng.integers(3))]
    found = []
    for kind in kinds:
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        away = rng.uniform(0.1, 0.5) if kind == "tube" else rng.uniform(0.45, 0.75)
        tip_xy = away * craniotomy.radius_m * np.array([np.cos(azimuth), np.sin(azimuth)])
        lift = rng.uniform(2e-3, 5e-3)
        if kind == "tube" and cavity is not None:
            tip_xy, lift = np.asarray(cavity.center_m), -0.4 * cavity.depth_m
        near = cortex[np.argsort(np.hypot(*(cortex[:, :2] - tip_xy).T))[:40]]
        tip = transform_points(T_patient_craniotomy, [*tip_xy, near[:, 2].max()])
        if shift is not None:
            tip = tip + shift(tip[None])[0]
        tip = tip + lift * craniotomy.axis
        elevation = np.deg2rad(rng.uniform(30.0, 50.0) if kind == "tube" else rng.uniform(18.0, 30.0))
        depth = float(transform_points(craniotomy.T_craniotomy_patient, tip)[2]) - near[:, 2].max()
        # It comes in over the edge of the bone, not through it.
        elevation = max(elevation, np.arctan2(_BONE_M - depth, craniotomy.radius_m - np.hypot(*tip_xy)))
        heading = azimuth + rng.uniform(-0.5, 0.5)
        outward = [np.cos(elevation) * np.cos(heading), np.cos(elevation) * np.sin(heading), np.sin(elevation)]
        end = tip + _INSTRUMENT_M * (T_patient_craniotomy[:3, :3] @ outward)
        if kind == "tube":
            found.append(suction_tube(tip, end, radius_m=rng.uniform(1.3e-3, 2.3e-3)))
        else:
            found.append(spatula(tip, end, craniotomy.axis, width_m=rng.uniform(7e-3, 13e-3)))
    return tuple(found)


def draw_tracker_error(center: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Tracker error of 0.1 to 0.3 mm with a turn of up to 0.06 degrees about `center`, tracker frame."""
    turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(0.0, 0.06)) * unit(rng.normal(size=3)))
    return rigid(turn, center - turn.apply(center) + rng.uniform(0.1e-3, 0.3e-3) * unit(rng.normal(size=3)))


def draw_start(
    T_patient_tracker: NDArray[np.float64], center: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Turn the true pose by up to 15 degrees about the craniotomy and move it by up to 10 mm."""
    turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(3.0, 15.0)) * unit(rng.normal(size=3)))
    offset = mm_to_m(rng.uniform(2.0, 10.0)) * unit(rng.normal(size=3))
    return rigid(turn, center - turn.apply(center) + offset) @ T_patient_tracker

"""The semi-automatic method on sheets whose shape is known: a planar falx, a tentorium on a cylinder."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.image.landmarks import SeptaSketch
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.septa.sketch import septa_from_sketch
from brainshift_ros.surface.surfacing import face_areas

RADIUS, TOP = 120.0, 60.0  # of a roof z = TOP - RADIUS + sqrt(RADIUS^2 - x^2), mm


def roof(x: NDArray[np.float64] | float) -> NDArray[np.float64]:
    return TOP - RADIUS + np.sqrt(RADIUS**2 - np.square(x))


def on_roof(*points: tuple[float, float]) -> list[list[float]]:
    return [[x, y, float(roof(x))] for x, y in points]


def sketch(tilt: float = 0.0, noise: float = 0.0, seed: int = 0) -> SeptaSketch:
    """Sketch a falx as a half ring of radii 40 and 90 mm, and under it a roof that is bent about the y axis.

    The clip's points, and the plane's, lie `tilt` (slope) off the roof: they are not on the sheet, only its targets are.
    """
    angle = np.linspace(0.0, np.pi, 13)[1:]
    arc = [[0.0, -float(np.cos(a)), float(np.sin(a))] for a in angle]
    grid = [(x, y) for x in (-10.0, -25.0, -40.0, -55.0) for y in (-85.0, -65.0, -48.0)]
    rng = np.random.default_rng(seed)
    targets = (np.array(on_roof(*grid)) + rng.normal(scale=noise, size=(len(grid), 3))).tolist()

    def off(points: list[tuple[float, float]]) -> list[list[float]]:
        return [[x, y, TOP - 15.0 + tilt * x] for x, y in points]

    return SeptaSketch.model_validate(
        {
            "midsagittal_plane": {"point": [0, 0, 0], "normal": [1, 0, 0]},
            "straight_sinus": [[0, -40, TOP], [0, -65, TOP], [0, -90, TOP]],
            "falx": {
                "outer_edge": [[0, 90 * y, TOP + 90 * z] for _, y, z in arc],
                "free_edge": [[0, 40 * y, TOP + 40 * z] for _, y, z in arc[-2::-1]],
            },
            "tentorium": {
                "left": {
                    "plane": off([(0.0, -40.0), (-50.0, -40.0), (0.0, -90.0)]),
                    "outline": off([(-20.0, -90.0), (-40.0, -90.0), (-60.0, -90.0), (-60.0, -65.0), (-60.0, -40.0)]),
                    "notch": off([(-40.0, -40.0), (-20.0, -40.0)]),
                    "targets": targets,
                },
                "right": "mirrored",
            },
        }
    )


def area_mm2(septum: Septum) -> float:
    return float(1e6 * face_areas(septum.surface).sum())


def test_the_falx_fills_its_periphery_in_its_plane() -> None:
    falx, _, _ = septa_from_sketch(sketch(), 4.0)
    assert np.abs(falx.surface.vertices[:, 0]).max() < 1e-12
    assert area_mm2(falx) == pytest.approx(np.pi * (90.0**2 - 40.0**2) / 2.0, rel=0.02)
    radius = 1e3 * np.hypot(falx.surface.vertices[falx.attached, 1], falx.surface.vertices[falx.attached, 2] - 1e-3 * TOP)
    np.testing.assert_allclose(radius, 90.0, atol=0.5)


@pytest.mark.parametrize("tilt", [-0.2, 0.0, 0.3])
def test_the_plane_is_morphed_onto_the_cylinder_whatever_its_tilt(tilt: float) -> None:
    _, left, right = septa_from_sketch(sketch(tilt), 4.0)
    for septum in (left, right):
        x, y, z = 1e3 * septum.surface.vertices.T
        within = (np.abs(x) < 56.0) & (y < -44.0)
        off = np.abs(z - roof(x))
        assert off[within].max() < 0.5
        assert off.max() < 2.5  # by the corners the spline goes beyond its targets
    if tilt == 0.0:
        expected = 50.0 * RADIUS * np.arcsin(60.0 / RADIUS)
        assert area_mm2(left) == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(
        np.sort(left.surface.vertices[left.attached], axis=0),
        np.sort(right.surface.vertices[right.attached] * [-1, 1, 1], axis=0),
        atol=1e-6 if tilt == 0.0 else 2e-3,
    )


def test_targets_are_met_and_their_noise_is_not_amplified() -> None:
    _, left, _ = septa_from_sketch(sketch(noise=1.0), 4.0)
    x, y, z = 1e3 * left.surface.vertices.T
    within = (x > -56.0) & (x < -5.0) & (y < -44.0)
    assert np.sqrt(np.mean(np.square(z - roof(x))[within])) < 2.0


def test_the_sheets_share_the_straight_sinus() -> None:
    sheets = septa_from_sketch(sketch(0.3), 5.0)
    common = set.intersection(*({tuple(v) for v in s.surface.vertices.round(9).tolist()} for s in sheets))
    assert len(common) == 11  # 50 mm in steps of 5
    assert all(x == 0.0 and z == pytest.approx(1e-3 * TOP) for x, _, z in common)


def test_the_clip_ends_at_the_midsagittal_plane() -> None:
    content = sketch().model_dump()
    content["tentorium"]["left"]["notch"] = [[-40.0, -40.0, 45.0], [6.0, -42.0, 45.0]]
    _, left, right = septa_from_sketch(SeptaSketch.model_validate(content), 4.0)
    assert left.surface.vertices[:, 0].max() < 1e-4
    assert right.surface.vertices[:, 0].min() > -1e-4


def test_repeated_targets_are_refused() -> None:
    content = sketch().model_dump()
    targets = content["tentorium"]["left"]["targets"]
    content["tentorium"]["left"]["targets"] = (*targets, targets[0])
    with pytest.raises(InputError, match="above each other"):
        septa_from_sketch(SeptaSketch.model_validate(content), 4.0)

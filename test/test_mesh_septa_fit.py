"""Sheets that do not belong to the brain are noticed before it is meshed."""

from __future__ import annotations

import re

import numpy as np
import pytest
import pyvista as pv

from brainshift_ros.errors import InputError
from brainshift_ros.septa.fit import check_septa
from brainshift_ros.septa.sheets import Septum, sheet
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import mm_to_m


def falx(shift_mm: float = 0.0, scale: float = 1.0) -> tuple[Septum, ...]:
    """Span a square of 100 mm in the plane x = 0."""
    ring = scale * np.array([[0.0, -50.0, -50.0], [0.0, 50.0, -50.0], [0.0, 50.0, 50.0], [0.0, -50.0, 50.0]])
    return (Septum("falx", sheet(ring + np.array([0.0, shift_mm, 0.0]), (), (1.0, 0.0, 0.0), 5.0 * scale)),)


@pytest.fixture(scope="module")
def brain() -> Surface:
    ball = pv.Sphere(radius=float(mm_to_m(75.0)), theta_resolution=40, phi_resolution=40)
    return Surface(np.asarray(ball.points, dtype=np.float64), np.asarray(ball.regular_faces, dtype=np.int32))


def test_a_sheet_inside_the_brain_passes_without_a_word(brain: Surface) -> None:
    assert check_septa(falx(), brain) == ()
    assert check_septa((), brain) == ()


def test_a_sheet_that_is_half_outside_is_said(brain: Surface) -> None:
    (warning,) = check_septa(falx(70.0), brain)
    y, z = np.meshgrid(np.linspace(20.0, 120.0, 501), np.linspace(-50.0, 50.0, 501))
    share = float((np.hypot(y, z) < 75.0).mean())
    said = re.search(r"only (\d+)% of the falx lies in the brain", warning)
    assert said is not None
    assert int(said[1]) == pytest.approx(100.0 * share, abs=2.0)


def test_a_sheet_elsewhere_is_refused(brain: Surface) -> None:
    with pytest.raises(InputError, match="only 0% of the falx lies in the brain"):
        check_septa(falx(200.0), brain)


def test_an_attached_edge_that_ends_inside_is_said(brain: Surface) -> None:
    (whole,) = falx()
    edge = np.flatnonzero(np.isclose(whole.surface.vertices[:, 2], mm_to_m(50.0))).astype(np.int32)
    (warning,) = check_septa((Septum("falx", whole.surface, edge),), brain)
    # the edge's middle lies 50 mm from the centre of a ball of 75 mm
    said = re.search(r"100% of the falx's attached edge ends inside the brain, up to (\S+) mm", warning)
    assert said is not None
    assert float(said[1]) == pytest.approx(25.0, abs=0.5)


def test_a_periphery_that_crosses_itself_is_refused() -> None:
    ring = np.array([[0.0, -50.0, -50.0], [0.0, 50.0, -50.0], [0.0, -50.0, 50.0], [0.0, 50.0, 50.0]])
    with pytest.raises(InputError, match="crosses itself near"):
        sheet(ring, (), (1.0, 0.0, 0.0), 5.0)


def test_landmarks_in_metres_or_twice_are_refused() -> None:
    with pytest.raises(InputError, match=r"measures 0\.1\d* mm from end to end"):
        falx(scale=0.001)
    ring = np.array([[0.0, -50.0, -50.0], [0.0, 50.0, -50.0], [0.0, 50.0, 50.0], [0.0, -50.0, 50.0]])
    with pytest.raises(InputError, match="above each other"):
        sheet(ring, [[3.0, 0.0, 0.0], [4.0, 0.0, 0.0]], (1.0, 0.0, 0.0), 5.0)

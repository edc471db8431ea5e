"""Septa carried over from the template: they move with the map, keep together, and reach out of the brain."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.image.resample import sample
from brainshift_ros.image.template import template_landmarks
from brainshift_ros.image.volume import Volume
from brainshift_ros.septa.sheets import Septum, septa_from_landmarks, sheet
from brainshift_ros.septa.strip import with_strips
from brainshift_ros.septa.template import septa_from_template
from brainshift_ros.simulation.truth import smooth_random_field
from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surfacing import vertex_normals

SPACING_MM = 6.0


def identity(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points


@pytest.fixture(scope="module")
def brain(template_case: tuple[Volume, Volume]) -> Volume:
    return template_case[1]


@pytest.fixture(scope="module")
def septa() -> tuple[Septum, ...]:
    return septa_from_template(identity, SPACING_MM)


def test_the_identity_gives_the_templates_sheets_and_strips(septa: tuple[Septum, ...]) -> None:
    for mapped, own in zip(septa, septa_from_landmarks(template_landmarks().septa, SPACING_MM), strict=True):
        count = len(own.surface.vertices)
        np.testing.assert_array_equal(mapped.surface.vertices[:count], own.surface.vertices)
        np.testing.assert_array_equal(mapped.surface.faces[: len(own.surface.faces)], own.surface.faces)
        edge = mapped.surface.vertices[mapped.attached] - own.surface.vertices[own.attached]
        np.testing.assert_allclose(np.linalg.norm(edge, axis=1), 0.006)


def test_attached_edges_lie_outside_the_brain_and_free_ones_inside(septa: tuple[Septum, ...], brain: Volume) -> None:
    for septum in septa:
        assert not sample(brain, septum.surface.vertices[septum.attached], "nearest").any()
    falx = septa[0]
    y, z = 1e3 * falx.surface.vertices[:, 1:].T
    on_free_edge = (np.abs(y) < 30) & (z < 46)
    assert sample(brain, falx.surface.vertices[on_free_edge], "nearest").all()


def test_a_registration_that_is_off_still_leaves_no_gap(brain: Volume) -> None:
    """A map that is wrong by 2.5 mm on average must not bring the attached edges into the brain."""

    def wrong(points: NDArray[np.float64]) -> NDArray[np.float64]:
        parts = [smooth_random_field(points, 0.04, np.random.default_rng([3, k])) for k in range(3)]
        return points + 0.0025 / np.sqrt(8 / np.pi) * np.stack(parts, axis=1)

    for septum in septa_from_template(wrong, SPACING_MM):
        assert not sample(brain, septum.surface.vertices[septum.attached], "nearest").any()


def test_the_three_sheets_share_the_straight_sinus_to_its_end(septa: tuple[Septum, ...]) -> None:
    def warped(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return points * [1.1, 0.9, 1.05] + 0.004 * np.sin(40.0 * points[:, [1, 2, 0]])

    for sheets in (septa, septa_from_template(warped, SPACING_MM)):
        falx, left, right = (s.surface.vertices for s in sheets)
        shared = (cKDTree(left).query(falx)[0] < 1e-9) & (cKDTree(right).query(falx)[0] < 1e-9)
        # the sinus is 59 mm long, the strip 6 mm
        assert np.linalg.norm(np.ptp(falx[shared], axis=0)) > 0.06
        assert shared.sum() >= 0.06 / (1.2 * 1e-3 * SPACING_MM)
        np.testing.assert_array_equal(shared[[sheets[0].attached[0]]], True)


def test_sheets_move_with_the_head(septa: tuple[Septum, ...]) -> None:
    turn, shift = Rotation.from_rotvec([0.2, -0.1, 0.3]), np.array([0.01, -0.03, 0.02])
    moved = septa_from_template(lambda points: turn.apply(points) + shift, SPACING_MM)
    for there, here in zip(moved, septa, strict=True):
        np.testing.assert_allclose(there.surface.vertices, turn.apply(here.surface.vertices) + shift, atol=1e-12)
        normals = vertex_normals(there.surface.vertices, there.surface.faces)
        axis = turn.apply([1.0, 0.0, 0.0] if here.name == "falx" else [0.0, 0.0, 1.0])
        assert (normals @ axis).mean() > 0.4


def test_maps_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="mirrors"):
        septa_from_template(lambda points: points * [-1.0, 1.0, 1.0], SPACING_MM)
    with pytest.raises(InputError, match="finite"):
        septa_from_template(lambda points: np.where(points > 0.07, np.nan, points), SPACING_MM)


def test_a_strip_goes_out_of_a_cleft_between_two_balls() -> None:
    """Two balls, one above the other: the way out of the cleft between them is sideways, also where a sheet slopes."""
    T = np.diag([0.002, 0.002, 0.002, 1.0])
    T[:3, 3] = -0.1
    x, y, z = np.moveaxis((np.indices((101, 101, 101)) * 2.0 - 100.0), 0, 0)
    balls = Volume(((x**2 + y**2 + (np.abs(z) - 40.0) ** 2) < 42.0**2).astype(np.uint8), T)
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    ring = 20.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.2 * np.cos(angle)])
    surface = sheet(ring, (), (0.0, 0.0, 1.0), 4.0)
    septum = Septum("tentorium", surface, np.arange(20, 40, dtype=np.int32))
    (longer,) = with_strips((septum,), balls, 4.0, strip_mm=8.0)
    along = longer.surface.vertices[longer.attached] - surface.vertices[septum.attached]
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 0.008)
    outward = surface.vertices[septum.attached][:, :2] / 0.02
    assert (np.einsum("ij,ij->i", along[:, :2], outward) > 0.7 * 0.008).all()
    # the edge slopes up to 4 mm off the middle of the cleft; the strip returns to it
    height = surface.vertices[septum.attached, 2]
    assert (along[:, 2] * height < 0.0)[np.abs(height) > 1e-4].all()
    # all faces of sheet and strip are oriented alike
    faces = longer.surface.faces
    directed = {tuple(e) for e in faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()}
    assert len(directed) == 3 * len(faces)
    assert with_strips((Septum("falx", surface),), balls, 4.0)[0].surface is surface
    distance = closest_points(surface, longer.surface.vertices[longer.attached]).distance
    assert distance.min() > 0.005

"""Surfaces from masks, smoothing that keeps the volume, sheets through landmarks, sides of sheets."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.image.template import template_landmarks
from brainshift_ros.image.volume import Volume
from brainshift_ros.septa.sheets import septa_from_landmarks, sheet
from brainshift_ros.septa.side import side_of_sheet
from brainshift_ros.surface.cortex import CLOSING_MM, DEPTH_MM, cortical_surface
from brainshift_ros.surface.queries import inside
from brainshift_ros.surface.surfacing import (
    decimate,
    enclosed_volume,
    face_areas,
    merged,
    smooth_laplacian,
    smooth_taubin,
    surface_of_mask,
)

RADIUS = 0.02
T = np.diag([0.001, 0.001, 0.001, 1.0])
T[:3, 3] = -0.03


def ball_mask() -> np.ndarray:
    points = transform_points(T, np.moveaxis(np.indices((61, 61, 61)), 0, -1))
    return np.linalg.norm(points, axis=-1) < RADIUS


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_surface_of_a_ball_points_outward_on_any_grid(mirror: float) -> None:
    surface = surface_of_mask(ball_mask(), T @ np.diag([mirror, 1.0, 1.0, 1.0]), blur=0.001)
    assert enclosed_volume(surface) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    assert face_areas(surface).sum() == pytest.approx(4 * np.pi * RADIUS**2, rel=0.03)


def test_blur_is_as_wide_across_thick_slices_as_in_them() -> None:
    thick = T @ np.diag([1.0, 1.0, 3.0, 1.0])
    surface = surface_of_mask(ball_mask()[:, :, ::3], thick, blur=0.004)
    # A ball stays round: a blur counted in voxels would flatten it by a millimetre and more along the slices' normal.
    assert np.ptp(surface.vertices, axis=0) == pytest.approx(np.full(3, np.ptp(surface.vertices[:, 0])), abs=0.0006)


def test_taubin_keeps_the_volume_that_laplace_loses() -> None:
    surface = surface_of_mask(ball_mask(), T)
    before = enclosed_volume(surface)
    taubin = abs(enclosed_volume(smooth_taubin(surface)) / before - 1)
    laplace = abs(enclosed_volume(smooth_laplacian(surface, iterations=100)) / before - 1)
    assert taubin < 0.002
    assert laplace > 5 * taubin


def test_decimation_keeps_the_shape() -> None:
    surface = smooth_taubin(surface_of_mask(ball_mask(), T, 0.001))
    few = decimate(surface, 1000)
    assert len(few.faces) <= 1000
    assert enclosed_volume(few) == pytest.approx(enclosed_volume(surface), rel=0.01)
    assert decimate(few, 2000) is few


def test_empty_mask_is_refused() -> None:
    with pytest.raises(InputError, match="is empty"):
        surface_of_mask(np.zeros((4, 4, 4), bool), T)


def test_inside_agrees_with_the_analytic_ball() -> None:
    surface = smooth_taubin(surface_of_mask(ball_mask(), T, 0.001))
    points = np.random.default_rng(0).uniform(-0.03, 0.03, (5000, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = np.abs(radius - RADIUS) > 0.001
    np.testing.assert_array_equal(inside(surface, points)[clear], radius[clear] < RADIUS)


def test_sheet_goes_through_its_landmarks_and_faces_its_normal() -> None:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.column_stack([30 * np.cos(angle), 20 * np.sin(angle), 0.2 * 30 * np.cos(angle)])
    interior = np.array([[0.0, 0.0, 8.0]])
    surface = sheet(ring, interior, (0, 0, 1), spacing_mm=2.0)
    np.testing.assert_allclose(surface.vertices[:40] * 1e3, ring, atol=1e-9)
    top = side_of_sheet(surface, interior * 1e-3)
    assert abs(top.height[0]) < 3e-4
    assert (np.cross(*np.moveaxis(np.diff(surface.vertices[surface.faces], axis=1), 1, 0))[:, 2] > 0).all()


def test_flat_sheet_has_the_area_of_its_polygon_and_right_sides() -> None:
    ring = np.array([[0, 0, 5], [40, 0, 5], [40, 10, 5], [20, 10, 5], [20, 30, 5], [0, 30, 5]], float)  # an L
    dense = np.vstack([ring[k] + (ring[(k + 1) % 6] - ring[k]) * t for k in range(6) for t in np.linspace(0, 1, 9)[:-1, None]])
    surface = sheet(dense, (), (0, 0, 1), spacing_mm=3.0)
    assert face_areas(surface).sum() == pytest.approx(800e-6, rel=1e-6)
    side = side_of_sheet(surface, np.array([[0.01, 0.01, 0.007], [0.01, 0.01, 0.002], [0.03, 0.02, 0.006]]))
    np.testing.assert_allclose(side.height, [0.002, -0.003, 0.001], atol=1e-6)
    np.testing.assert_allclose(side.overshoot, [0, 0, 0.01], atol=1e-6)


def test_septa_meet_along_the_straight_sinus() -> None:
    falx, left, right = septa_from_landmarks(template_landmarks().septa)
    shared = {tuple(v) for v in falx.surface.vertices.round(9)} & {tuple(v) for v in left.surface.vertices.round(9)}
    assert len(shared) >= 10
    roof = merged([left.surface, right.surface])
    assert len(roof.vertices) < len(left.surface.vertices) + len(right.surface.vertices) - 8
    # over the roof's ridge is above, under it below, and in the notch is past the edge
    side = side_of_sheet(roof, np.array([[0.0, -0.07, 0.006], [0.0, -0.07, -0.02], [0.0, -0.03, -0.02]]))
    assert side.height[0] > 0 > side.height[1]
    assert side.overshoot[2] > 0.005


def test_cortex_shows_grooves_of_a_few_millimetres() -> None:
    spacing = 1e-3
    T = np.diag([spacing, spacing, spacing, 1.0])
    radius = np.linalg.norm(np.indices((72, 72, 72)) - 35.5, axis=0)
    labels = Volume((radius < 30).astype(np.uint8), T)
    groove = (np.abs(np.indices((72, 72, 72))[0] - 35.5) < 4) & (radius > 25)  # wider than the closing bridges
    slit = (np.abs(np.indices((72, 72, 72))[1] - 35.5) < 1) & (radius > 25)  # narrower
    noise = np.random.default_rng(0).normal(scale=0.02, size=radius.shape)
    t1 = Volume(np.where(labels.data > 0, np.where(groove | slit, 0.2, np.where(radius > 20, 0.6, 0.8)) + noise, 0.0), T)
    surface = cortical_surface(t1, labels)
    from_centre = (surface.vertices - 35.5e-3) * 1e3
    height = np.linalg.norm(from_centre, axis=1)
    in_groove = (np.abs(from_centre[:, 0]) < 1.5) & (from_centre[:, 2] > 15)
    in_slit = (np.abs(from_centre[:, 1]) < 0.7) & (np.abs(from_centre[:, 0]) > 10)
    assert height[in_groove].mean() == pytest.approx(25.0, abs=1.0)
    assert height[in_slit].mean() > 28.5
    assert height.min() > 30 - DEPTH_MM - 1
    assert CLOSING_MM < 4

"""Figures of a field: written, of a sane size, and with the patient's sides where the labels say."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import ellipsoid_mesh, smooth_field, top_nodes
from matplotlib.figure import Figure
from matplotlib.image import imread

from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.warp import warp_image
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.volume import Volume
from brainshift_ros.mesh.nearest import boundary_faces
from brainshift_ros.pictures.field import contour_step, displacement_map, mr_before_after, vectors_on_cortex
from brainshift_ros.pictures.slices import three_slices
from brainshift_ros.surface.surface import Surface

MESH = ellipsoid_mesh(8)
GRID = Grid((50, 52, 48), np.array([[0.003, 0, 0, -0.074], [0, 0.003, 0, -0.077], [0, 0, 0.003, -0.07], [0, 0, 0, 1.0]]))


@pytest.fixture(scope="module")
def scene():
    deformation = Deformation(smooth_field(MESH), spacing=0.004)
    inside = deformation.inside(GRID)
    image = Volume((100 * inside).astype(np.float32), GRID.T_patient_voxel)
    return deformation, inside, image


def looks_drawn(path):
    pixels = imread(path)[..., :3]
    return min(pixels.shape[:2]) > 300 and pixels.std() > 0.1


def test_figures_are_written(scene, tmp_path):
    deformation, inside, image = scene
    warped = warp_image(deformation, image)
    mr_before_after(tmp_path / "mr.png", image, warped.volume, warped.inverse, [0.0, 0.02, 0.01])
    displacement_map(tmp_path / "shift.png", image, deformation.forward_on(GRID), inside, [0.0, 0.02, 0.01])
    faces, _ = boundary_faces(MESH.elements)
    nodes = top_nodes(MESH, 12)
    shift = deformation.field.displacement[nodes]
    used = np.arange(12) > 0
    vectors_on_cortex(tmp_path / "vectors.png", Surface(MESH.nodes, faces), MESH.nodes[nodes], shift, 0.9 * shift, used)
    for name in ("mr.png", "shift.png", "vectors.png"):
        assert looks_drawn(tmp_path / name), name


def test_a_still_brain_can_be_drawn(scene, tmp_path):
    _, inside, image = scene
    nothing = np.zeros((*GRID.shape, 3), np.float32)
    mr_before_after(tmp_path / "mr.png", image, image, nothing, [0.0, 0.0, 0.0])
    displacement_map(tmp_path / "shift.png", image, nothing, inside, [0.0, 0.0, 0.0])
    assert looks_drawn(tmp_path / "mr.png")


@pytest.mark.parametrize("flip", [np.diag([1.0, 1, 1, 1]), np.diag([-1.0, -1, -1, 1])])
def test_slices_show_the_patient_whatever_the_axes_of_the_file(flip):
    # A bright spot at the patient's right, anterior, superior; stored with axes either way.
    T = flip @ np.diag([0.002, 0.002, 0.002, 1.0])
    T[:3, 3] = -T[:3, :3] @ [25, 25, 25]
    grid = Grid((51, 51, 51), T)
    data = np.full(grid.shape, 10.0, np.float32)
    data[tuple(np.rint(grid.to_voxels(np.array([0.03, 0.02, 0.01]))).astype(int))] = 100.0
    for plane in three_slices(Volume(data, T), [0.03, 0.02, 0.01]):
        shown = plane.sample(data, grid)
        row, column = np.unravel_index(np.argmax(shown), shown.shape)
        a, b, _ = plane.axes
        assert plane.across_mm[column] == pytest.approx([30.0, 20.0, 10.0][a], abs=1.0)
        assert plane.up_mm[row] == pytest.approx([30.0, 20.0, 10.0][b], abs=1.0)


def test_letters_stand_at_their_sides(scene):
    _, _, image = scene
    for plane, (left, right, top, bottom) in zip(three_slices(image, [0, 0, 0]), ("RLAP", "RLSI", "APSI"), strict=True):
        axes = Figure().add_subplot()
        plane.prepare(axes)
        places = {text.get_text(): text.get_position() for text in axes.texts}
        assert places[left][0] < 0.1 < 0.9 < places[right][0]
        assert places[bottom][1] < 0.1 < 0.9 < places[top][1]
        assert axes.get_xlim()[0] > axes.get_xlim()[1], "R and A are at the larger coordinate, drawn on the left"


@pytest.mark.parametrize("largest", [0.03, 0.4, 3.0, 9.9, 28.0, 60.0])
def test_contours_are_few_and_round(largest):
    assert largest / contour_step(largest) <= 10.0

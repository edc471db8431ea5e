"""The picture of boundary conditions shows each kind where it acts."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mechanics_cases import head, patient

from brainshift_ros.atlas.scene import Craniotomy, Gravity, Mannitol, Model, Scene
from brainshift_ros.mechanics.boundary import boundary_of, in_cap, node_kinds
from brainshift_ros.mechanics.space import space_of
from brainshift_ros.pictures.boundary import BoundaryCase, boundary_figure, draw_facets
from brainshift_ros.pictures.conditions import conditions_page


def test_the_cap_is_red_on_top_and_the_brainstem_blue():
    mesh = head(8)
    boundary = boundary_of(space_of(mesh))
    kinds = [node_kinds(boundary, in_cap(mesh.nodes, down, 0.8)) for down in ([0.0, 0.0, -1.0], [0.0, -1.0, 0.0])]
    drained = {"low": np.ones(len(mesh.nodes), bool)}
    cases = [BoundaryCase(name, of, drained) for name, of in zip(("upright", "supine"), kinds, strict=True)]
    figure = boundary_figure(mesh, cases)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    upright, supine = figure.axes[0], figure.axes[1]
    faces = [axes.collections[0].get_facecolor()[:, :3] for axes in (upright, supine)]
    heights = [
        np.array([path.vertices[:3, 1].mean() for path in axes.collections[0].get_paths()]) for axes in (upright, supine)
    ]
    red = [(face[:, 0] > 1.3 * face[:, 1]) & (face[:, 0] > 1.3 * face[:, 2]) for face in faces]
    blue = [(face[:, 2] > 1.2 * face[:, 0]) & (face[:, 2] > 1.1 * face[:, 1]) for face in faces]
    assert heights[0][red[0]].mean() > 30.0 > heights[1][red[1]].mean()  # mm up the page
    assert heights[0][blue[0]].mean() < -30.0
    assert len(figure.legends[0].get_texts()) == 5  # fixed, slip, free; no flux, atmospheric
    pressure = figure.axes[-1].collections[0].get_facecolor()[:, :3]
    assert np.all(pressure[:, 1] > pressure[:, 2])  # all of the skull is green: atmospheric


def test_near_facets_are_drawn_last():
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.0, 0, 1], [1, 0, 1], [0, 1, 1]])
    facets = np.array([[3, 4, 5], [0, 1, 2]], np.int32)
    colors = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    for camera, last in ((1.0, [1, 0, 0]), (-1.0, [0, 0, 1])):
        axes = Figure().subplots()
        draw_facets(axes, nodes, facets, colors, (0.0, 0.0, camera), (0.0, 1.0, 0.0))
        np.testing.assert_allclose(axes.collections[0].get_facecolor()[-1, :3], last)


def test_a_scene_s_conditions_are_drawn_for_three_orientations():
    scene = Scene(
        gravity=Gravity(direction=(0.0, 0.0, -1.0), cone_deg=25.0, orientations=6, fluid_levels=2),
        mannitol=Mannitol(),
        resection="both",
        craniotomy=Craniotomy(center_mm=(0.0, 0.0, 70.0), diameter_mm=60.0),
    )
    figure = conditions_page(patient(head(8)), scene)
    titles = [axes.get_title() for axes in figure.axes]
    for row, times in (("skull, from below", 3), ("wall of the resected tumour", 3), ("pressure, gravity", 6), ("mannitol", 3)):
        assert sum(row in title for title in titles) == times
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"fixed", "slip", "stress-free", "one-sided skull contact", "cavity wall (stress-free)"} <= labels
    free_cap = scene.model_copy(update={"model": Model(skull="free_cap"), "resection": "none"})
    labels = {text.get_text() for text in conditions_page(patient(head(8)), free_cap).legends[0].get_texts()}
    assert "stress-free" in labels
    assert not labels & {"one-sided skull contact", "cavity wall (stress-free)"}

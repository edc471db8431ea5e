"""`brainshift solve` with its options, and the page that it draws of an estimate."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from field_cases import ellipsoid_mesh, sagging_atlas, top_nodes
from matplotlib.image import imread

from brainshift_ros.atlas.file import AtlasContent, write_atlas
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.cli import solve
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.field.field_file import read_field
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.methods import METHODS
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.points_csv import write_homologous_points
from brainshift_ros.mesh.nearest import boundary_faces
from brainshift_ros.pictures.estimate import draw_estimate

MESH = replace(ellipsoid_mesh(8), facets={"skull": boundary_faces(ellipsoid_mesh(8).elements)[0]})
ATLAS = sagging_atlas(MESH, entries=12)
TRUTH = ATLAS.E[:, :, :2].astype(float) @ [0.4, 0.3]
NODES = top_nodes(MESH, 18)
MEASURED = HomologousPoints(MESH.nodes[NODES], TRUTH[NODES], np.full(18, 5e-4))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("solve")
    tissue = np.ones(len(MESH.elements), np.uint8)
    scene = Scene.model_validate({"gravity": {"direction": [0.0, -1.0, 0.0]}})
    write_atlas(folder / "atlas.h5", AtlasContent(ATLAS.patient_id, MESH, tissue, scene, ATLAS.entries, ATLAS.groups), ATLAS.E)
    write_homologous_points(folder / "points.csv", MEASURED)
    return folder


def run(folder, output, *options, points="points.csv"):
    arguments = [folder / "atlas.h5", folder / points, "-o", output / "field.h5", *options]
    result = CliRunner().invoke(solve.command, [str(argument) for argument in arguments], catch_exceptions=False)
    return result.exit_code, result.output


@pytest.mark.parametrize("method", METHODS)
def test_every_method_can_be_chosen_and_is_named_in_what_is_written(folder, tmp_path, method):
    status, output = run(folder, tmp_path, "--method", method, "--json", tmp_path / "e.json")
    assert status in (0, solve.NOT_VALID), output
    estimate = json.loads((tmp_path / "e.json").read_text())
    assert estimate["method"] == read_field(tmp_path / "field.h5").provenance["method"] == method
    error = np.linalg.norm(read_field(tmp_path / "field.h5").displacement - TRUTH, axis=1)
    if method in ("constrained", "nnls", "osqp", "clarabel"):
        assert error.max() < 1e-5
    assert output.splitlines()[-1] == f"wrote {tmp_path / 'field.h5'}, {tmp_path / 'e.json'}"


def test_the_limit_of_outliers_is_an_option(folder, tmp_path):
    shifted = MEASURED.displacements.copy()
    shifted[4] += [0.004, 0.0, 0.0]  # eight sigmas
    write_homologous_points(folder / "one_wrong.csv", replace(MEASURED, displacements=shifted))
    used = {}
    for limit in ("3", "50"):
        run(folder, tmp_path, "--outlier-sigmas", limit, "--json", tmp_path / "e.json", points="one_wrong.csv")
        used[limit] = [point["used"] for point in json.loads((tmp_path / "e.json").read_text())["points"]]
    assert used["3"] == [number != 4 for number in range(18)]
    assert all(used["50"])


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (["--method", "guess"], "'guess' is not one of 'constrained', 'least_squares'"),
        (["--outlier-sigmas", "1"], "1.0 is not in the range 2.0<=x<=100.0"),
        (["--max-outside-mm", "-1"], "-1.0 is not in the range 0.0<=x<=50.0"),
        (["--outlier-sigmas", "nan"], "nan is not a number"),
    ],
)
def test_wrong_options_are_named(folder, tmp_path, options, fault):
    status, output = run(folder, tmp_path, *options)
    assert status == 2
    assert fault in output
    assert not list(tmp_path.iterdir())


def test_targets_that_cannot_be_written_are_named_before_anything_is_computed(folder, tmp_path):
    with pytest.raises(InputError, match=r"page\.jpg: its name does not end in \.png"):
        run(folder, tmp_path, "--picture", tmp_path / "page.jpg")
    with pytest.raises(InputError, match="its folder does not exist"):
        run(folder, tmp_path, "--json", tmp_path / "none" / "e.json")
    assert not list(tmp_path.iterdir())


def test_the_picture_is_written(folder, tmp_path):
    _, output = run(folder, tmp_path, "--picture", tmp_path / "page.png")
    pixels = imread(tmp_path / "page.png")[..., :3]
    assert min(pixels.shape[:2]) > 1000
    assert pixels.std() > 0.1
    assert output.splitlines()[-1] == f"wrote {tmp_path / 'field.h5'}, {tmp_path / 'page.png'}"


def test_the_page_shows_what_the_estimate_says():
    shifted = MEASURED.displacements.copy()
    shifted[4] += [0.009, 0.0, 0.0]
    estimate = estimate_shift(ATLAS, replace(MEASURED, displacements=shifted))
    assert estimate.valid
    figure = draw_estimate(estimate)
    heading = figure.get_suptitle()
    assert heading.startswith("valid\nshift of 17 of 18 points")
    assert f"correction {estimate.correction_percent:.0f} %" in heading
    above, _, mechanisms, weights, residuals = figure.axes
    assert [text.get_text() for text in above.get_legend().get_texts()] == ["measured", "predicted", "measured, dropped"]
    assert mechanisms.patches[0].get_height() == pytest.approx(1e3 * estimate.mechanisms["gravity"].shift)
    assert [bar.get_width() for bar in weights.patches] == pytest.approx([item.weight for item in estimate.weights])
    assert [len(points.get_offsets()) for points in residuals.collections] == [17, 1]


def test_the_page_of_many_weights_shows_the_largest_and_counts_the_rest():
    atlas = sagging_atlas(MESH, entries=40)
    noisy = MEASURED.displacements + np.random.default_rng(0).normal(0.0, 1e-3, (18, 3))
    estimate = estimate_shift(atlas, replace(MEASURED, displacements=noisy), options=InverseOptions(method="least_squares"))
    figure = draw_estimate(estimate)
    assert len(figure.axes[3].patches) == 12
    assert figure.axes[3].get_title() == f"{len(estimate.weights)} weights are not zero; {len(estimate.weights) - 12} not shown"


def test_the_page_of_an_estimate_that_is_not_valid_says_so_in_red():
    estimate = estimate_shift(ATLAS, replace(MEASURED, displacements=-MEASURED.displacements))
    assert not estimate.valid
    figure = draw_estimate(estimate)
    assert figure.get_suptitle().startswith("NOT VALID: ")
    assert figure._suptitle.get_color() == "tab:red"
    assert [text.get_text() for text in figure.axes[3].texts] == ["every weight is zero"]

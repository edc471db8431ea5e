"""The template map against analytic maps and SimpleITK, and what a segmentation refuses before it registers anything."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import T_LPS_RAS, rigid, transform_points
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.volume import Volume
from brainshift_ros.segmentation.checks import check_linear, check_map
from brainshift_ros.segmentation.greedy import run_greedy
from brainshift_ros.segmentation.initial import brain_centres
from brainshift_ros.segmentation.likeness import Likeness, likeness
from brainshift_ros.segmentation.register import LinearRegistration
from brainshift_ros.segmentation.segment import carried
from brainshift_ros.segmentation.template_map import TemplateMap
from brainshift_ros.segmentation.working_images import WorkingImages, working_images
from brainshift_ros.units import m_to_mm, mm_to_m

T_RIGID = rigid(Rotation.from_euler("xyz", [20, -10, 5], degrees=True), [0.01, -0.04, 0.03])
STRETCH = np.array([[1.05, 0.03, 0.0, 0.002], [0.0, 0.93, 0.02, 0.0], [0.01, 0.0, 1.02, -0.001], [0.0, 0.0, 0.0, 1.0]])


def waves(x: NDArray[np.float64], amplitude: float = 0.006) -> NDArray[np.float64]:
    """A smooth displacement whose gradient stays below 2 pi amplitude / 0.1 per component."""
    return amplitude * np.sin(2.0 * np.pi * x[:, [1, 2, 0]] / 0.1)


def wavy_map(spacing: float = 0.002, amplitude: float = 0.006) -> TemplateMap:
    grid = Grid.around([[-0.05, -0.06, -0.04], [0.05, 0.06, 0.04]], spacing, 0.0)
    centres = grid.centres(np.argwhere(np.ones(grid.shape)))
    u = waves(centres, amplitude).astype(np.float32).reshape(*grid.shape, 3)
    return TemplateMap.create(T_RIGID, T_RIGID @ STRETCH, u, grid.T_patient_voxel)


@pytest.fixture(scope="module")
def wavy() -> TemplateMap:
    return wavy_map()


def points_inside(count: int = 500, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(-0.035, 0.035, (count, 3))


def test_map_composes_displacement_affine_and_rigid(wavy: TemplateMap) -> None:
    x = points_inside()
    expected = transform_points(T_RIGID, transform_points(STRETCH, x + waves(x)))
    assert m_to_mm(np.abs(wavy.to_patient(x) - expected)).max() < 0.05


def test_map_and_inverse_agree_both_ways(wavy: TemplateMap) -> None:
    x = points_inside()
    assert m_to_mm(np.linalg.norm(wavy.to_template(wavy.to_patient(x)) - x, axis=1)).max() < 0.05
    y = wavy.to_patient(x)
    assert m_to_mm(np.linalg.norm(wavy.to_patient(wavy.to_template(y)) - y, axis=1)).max() < 0.05
    assert m_to_mm(np.linalg.norm(wavy.to_template_from_table(y) - x, axis=1)).max() < 0.3


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-0.3, 0.3)] * 3), min_size=1, max_size=5))
def test_inverse_holds_far_outside_the_grid(wavy: TemplateMap, points: list[tuple[float, float, float]]) -> None:
    y = np.array(points)
    assert m_to_mm(np.abs(wavy.to_patient(wavy.to_template(y)) - y)).max() < 0.05


def test_map_agrees_with_simpleitk(wavy: TemplateMap) -> None:
    flip = T_LPS_RAS[:3, :3]
    field = sitk.GetImageFromArray(m_to_mm(wavy.displacement @ flip).transpose(2, 1, 0, 3), isVector=True)
    lps = T_LPS_RAS @ wavy.T_template_voxel
    edges = np.linalg.norm(lps[:3, :3], axis=0)
    field.SetOrigin(m_to_mm(lps[:3, 3]).tolist())
    field.SetSpacing(m_to_mm(edges).tolist())
    field.SetDirection((lps[:3, :3] / edges).ravel().tolist())
    T = T_LPS_RAS @ wavy.T_affine @ T_LPS_RAS
    affine = sitk.AffineTransform(T[:3, :3].ravel().tolist(), m_to_mm(T[:3, 3]).tolist())
    # ITK applies the last transform of a composite first.
    both = sitk.CompositeTransform([affine, sitk.DisplacementFieldTransform(sitk.Cast(field, sitk.sitkVectorFloat64))])
    x = points_inside(50)
    theirs = np.array([both.TransformPoint(p.tolist()) for p in m_to_mm(x @ flip)])
    assert np.abs(m_to_mm(wavy.to_patient(x)) - theirs @ flip).max() < 1e-3


def test_map_is_kept_as_plain_arrays(wavy: TemplateMap) -> None:
    arrays = dataclasses.asdict(wavy)
    assert all(isinstance(a, np.ndarray) for a in arrays.values())
    again = TemplateMap(**arrays)
    x = points_inside()
    assert np.array_equal(again.to_patient(x), wavy.to_patient(x))
    assert np.array_equal(again.to_template(x), wavy.to_template(x))


def test_jacobian_is_that_of_the_analytic_map(wavy: TemplateMap) -> None:
    grid = wavy.grid
    indices = np.argwhere(np.ones(grid.shape))
    x = grid.centres(indices)
    slope = 2.0 * np.pi / 0.1 * 0.006 * np.cos(2.0 * np.pi * x / 0.1)
    # u_i depends on x_(i+1) alone, so det (1 + grad u) is 1 plus the product of the three slopes.
    expected = (1.0 + slope.prod(axis=1)) * np.linalg.det(STRETCH[:3, :3])
    inner = np.all((indices > 0) & (indices < np.array(grid.shape) - 1), axis=1)
    assert np.abs(wavy.jacobian_determinant().ravel() - expected)[inner].max() < 0.01
    assert check_map(wavy) == ()


def test_folding_is_reported() -> None:
    shape = (12, 12, 12)
    u = np.zeros((*shape, 3), dtype=np.float32)
    u[..., 0] = 0.003 * (-1.0) ** (np.arange(12)[:, None, None] // 2)
    folding = TemplateMap.create(np.eye(4), np.eye(4), u, np.diag([0.002, 0.002, 0.002, 1.0]))
    (warning,) = check_map(folding)
    assert "folds" in warning


def test_labels_are_carried_to_a_flipped_permuted_grid() -> None:
    T_template = np.diag([0.002, 0.002, 0.002, 1.0])
    T_template[:3, 3] = -0.04
    data = np.zeros((41, 41, 41), dtype=np.uint8)
    data[5:20, 8:33, 8:33], data[20:36, 8:33, 8:33] = 1, 2
    regions = Volume(data, T_template)
    identity = TemplateMap.create(T_RIGID, T_RIGID, np.zeros((41, 41, 41, 3), dtype=np.float32), T_template)
    # Index axes of the patient: superior to inferior, right to left, posterior to anterior, 1.5 mm.
    axes = 0.0015 * np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    T_patient_voxel = np.eye(4)
    T_patient_voxel[:3, :3] = T_RIGID[:3, :3] @ axes
    T_patient_voxel[:3, 3] = transform_points(T_RIGID, -axes @ [30, 30, 30])
    t1 = Volume(np.zeros((61, 61, 61), dtype=np.float32), T_patient_voxel)
    labels = carried(regions, identity, t1)
    indices = np.argwhere(np.ones(labels.shape))
    x = transform_points(np.linalg.inv(T_RIGID), Grid.of(t1).centres(indices))
    nearest = np.rint((x + 0.04) / 0.002)
    # Halves of a template voxel may round either way.
    clear = np.abs((x + 0.04) / 0.002 - nearest).max(axis=1) < 0.499
    nearest = nearest.astype(int)
    within = np.all((nearest >= 0) & (nearest < 41), axis=1)
    expected = np.zeros(len(indices), dtype=np.uint8)
    expected[within] = data[tuple(nearest[within].T)]
    assert np.array_equal(labels.data.ravel()[clear], expected[clear])
    assert set(np.unique(labels.data)) == {0, 1, 2}


def block_images(cut: int = 0) -> WorkingImages:
    """A textured ball of 40 mm as the template, the same ball as the patient, on a grid that may miss some slices."""
    T = np.diag([0.002, 0.002, 0.002, 1.0])
    T[:3, 3] = -0.04
    rng = np.random.default_rng(1)
    ball = np.linalg.norm(np.indices((41, 41, 41)) - 20.0, axis=0) < 15
    data = np.where(ball, 1.0 + rng.random(ball.shape), 0.0).astype(np.float32)
    T_cut = T.copy()
    T_cut[2, 3] += 0.002 * cut
    return working_images(Volume(data, T), ball, Volume(data[:, :, cut:], T_cut), None, 2.0, 4.0)


def test_likeness_of_equal_images_is_one_and_of_shifted_ones_low() -> None:
    images = block_images()
    same = likeness(images, lambda x: x)
    assert same.seen == 1.0
    assert same.correlation_ratio > 0.95
    shifted = likeness(images, lambda x: x + np.array([0.012, 0.0, 0.0]))
    assert shifted.correlation_ratio < 0.3
    assert likeness(images, lambda x: x + 1.0) == Likeness(0.0, 0.0)


def test_likeness_counts_what_lies_beyond_the_image() -> None:
    # Half the ball's slices are missing.
    assert likeness(block_images(cut=20), lambda x: x).seen == pytest.approx(0.5, abs=0.08)


def test_tumor_is_left_out_of_the_metric_and_of_the_likeness() -> None:
    T = np.diag([0.002, 0.002, 0.002, 1.0])
    ball = np.linalg.norm(np.indices((41, 41, 41)) - 20.0, axis=0) < 15
    t1 = Volume(ball.astype(np.float32), T)
    tumor = np.zeros(ball.shape, dtype=bool)
    tumor[18:23, 18:23, 18:23] = True
    images = working_images(t1, ball, t1, Volume(tumor, T), 2.0, 4.0)
    inside = Grid.of(images.known).to_voxels(Grid.of(t1).centres(np.argwhere(tumor)))
    assert not images.known.data[tuple(np.rint(inside).astype(int).T)].any()
    assert images.healthy.data.sum() < images.healthy.data.size
    assert likeness(images, lambda x: x).seen == 1.0


LIKE = Likeness(seen=1.0, correlation_ratio=0.7)


@pytest.mark.parametrize(
    ("change", "scale", "words"),
    [
        ({"seen": 0.2}, 1.0, "20% of a brain"),
        ({"correlation_ratio": 0.1}, 1.0, "does not look like a head"),
        ({}, 0.5, "0.50 x 0.50 x 0.50"),
        ({}, 1.7, "1.70 x 1.70 x 1.70"),
    ],
)
def test_what_cannot_be_a_head_is_refused(change: dict[str, float], scale: float, words: str) -> None:
    linear = LinearRegistration(np.eye(4), np.diag([scale, scale, scale, 1.0]), {}, 0.0)
    with pytest.raises(InputError, match="--labels") as caught:
        check_linear(linear, dataclasses.replace(LIKE, **change))
    assert words in str(caught.value)


def test_what_is_unusual_is_said() -> None:
    linear = LinearRegistration(np.eye(4), np.diag([0.7, 1.0, 1.0, 1.0]), {}, 0.0)
    cut, little, size = check_linear(linear, Likeness(0.8, 0.35))
    assert "cut by the image's edge: about 20%" in cut
    assert "little like the template" in little
    assert "1.00 x 1.00 x 0.70" in size
    assert check_linear(dataclasses.replace(linear, T_affine=np.eye(4)), LIKE) == ()


def test_brain_is_expected_below_the_vertex_not_in_the_neck() -> None:
    data = np.zeros((60, 60, 100), dtype=np.float32)
    x, y, z = np.indices(data.shape)
    data[((x - 30) / 18) ** 2 + ((y - 30) / 22) ** 2 + ((z - 75) / 20) ** 2 < 1] = 1.0
    data[20:40, 20:40, :60] = 1.0
    head = Volume(data, np.diag([0.004, 0.004, 0.004, 1.0]))
    for centre in brain_centres(head):
        assert m_to_mm(np.linalg.norm(centre - mm_to_m([120.0, 120.0, 300.0]))) < 20.0
    with pytest.raises(InputError, match="all voxels are equal"):
        brain_centres(Volume(np.ones((4, 4, 4)), np.eye(4)))


def test_what_greedy_cannot_do_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the rigid registration ended with status"):
        run_greedy(tmp_path, "-i missing.nii also.nii -a -o out.mat", "rigid", 60.0)

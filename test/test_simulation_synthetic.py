"""The synthetic patient: its true map is a diffeomorphism, its images obey that map, and its head looks like a T1."""

from __future__ import annotations

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from scipy import ndimage
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import rigid, transform_points
from brainshift_ros.image.resample import sample
from brainshift_ros.image.template import template_labels, template_landmarks, template_t1
from brainshift_ros.image.tumor import TumorShape
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.septa.sheets import septa_from_landmarks
from brainshift_ros.simulation.synthetic_carry import block_mean
from brainshift_ros.simulation.synthetic_grid import cut_off, oblique, reoriented, thick_slices
from brainshift_ros.simulation.synthetic_mr import WHITE, Contrast, imaged, with_tumor
from brainshift_ros.simulation.synthetic_noise import interpolation_matrix, smooth_noise, tensor_product
from brainshift_ros.simulation.synthetic_patient import SyntheticPatient, synthetic_patient
from brainshift_ros.simulation.synthetic_warp import BOX_MM, NODE_MM, SyntheticWarp, jacobian_determinant, random_warp
from brainshift_ros.units import m_to_mm, mm_to_m

TUMOR = TumorShape()


def brain_points_mm(count: int = 1500) -> np.ndarray:
    """Points in an ellipsoid of a brain's size, about where the template's lies."""
    direction = np.random.default_rng(7).normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = np.random.default_rng(8).uniform(size=(count, 1)) ** (1 / 3)
    return np.array([0.0, -18.0, 5.0]) + direction * radius * [70.0, 88.0, 72.0]


@pytest.fixture(scope="module")
def warp() -> SyntheticWarp:
    pose = rigid(Rotation.from_euler("xyz", [5, -4, 3], degrees=True), [0.004, -0.006, 0.003])
    return random_warp(np.random.default_rng(3), brain_points_mm(), 6.0, pose)


@pytest.fixture(scope="module")
def patient() -> SyntheticPatient:
    return synthetic_patient(1, tumor=TUMOR, spacing_mm=(2.0, 2.0, 3.0))


@pytest.fixture(scope="module")
def head() -> SyntheticPatient:
    return synthetic_patient(2, whole_head=True, noise=0.0, bias=0.0, spacing_mm=2.0, tilt_deg=0.0, offset_mm=0.0)


def test_the_map_is_the_flow_of_its_velocity(warp: SyntheticWarp) -> None:
    """exp(-v) by scaling and squaring against an adaptive integrator; so is exp(v), which is its inverse."""
    start = brain_points_mm(40)
    end = {}
    for sign in (1.0, -1.0):
        path = solve_ivp(
            lambda _, x, s=sign: s * warp.velocity(x.reshape(-1, 3)).ravel(), (0.0, 1.0), start.ravel(), rtol=1e-9, atol=1e-9
        )
        end[sign] = path.y[:, -1].reshape(-1, 3)
    np.testing.assert_allclose(start + warp.backward(start), end[-1.0], atol=0.02)
    moved = m_to_mm(transform_points(np.linalg.inv(warp.T_patient_warped), warp.to_patient(mm_to_m(start))))
    np.testing.assert_allclose(moved, end[1.0], atol=0.02)


def test_both_directions_are_inverse(warp: SyntheticWarp) -> None:
    points = mm_to_m(brain_points_mm() * 1.2)
    np.testing.assert_allclose(warp.to_template(warp.to_patient(points)), points, atol=mm_to_m(1e-3))
    np.testing.assert_allclose(warp.to_patient(warp.to_template(points)), points, atol=mm_to_m(1e-3))


def test_displacement_is_as_asked_and_no_mere_pose(warp: SyntheticWarp) -> None:
    start = brain_points_mm()
    moved = m_to_mm(transform_points(np.linalg.inv(warp.T_patient_warped), warp.to_patient(mm_to_m(start))))
    length = np.linalg.norm(moved - start, axis=1)
    assert length.mean() == pytest.approx(6.0, abs=0.05)
    assert (warp.mean_mm, warp.max_mm) == pytest.approx((length.mean(), length.max()), abs=0.01)
    turn, _ = Rotation.align_vectors(moved - moved.mean(axis=0), start - start.mean(axis=0))
    left = moved - moved.mean(axis=0) - turn.apply(start - start.mean(axis=0))
    assert np.linalg.norm(left, axis=1).mean() > 5.0


def test_it_never_folds_and_simpleitk_says_so_too(warp: SyntheticWarp) -> None:
    axes = [np.arange(low + 40.0, high - 40.0, 4.0) for low, high in BOX_MM]
    grid_mm = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    points = grid_mm.reshape(-1, 3)
    displacement = warp.backward(points).reshape(grid_mm.shape)
    field = sitk.GetImageFromArray(np.ascontiguousarray(displacement.transpose(2, 1, 0, 3)), isVector=True)
    field.SetSpacing((4.0, 4.0, 4.0))
    theirs = sitk.GetArrayFromImage(sitk.DisplacementFieldJacobianDeterminant(field)).T
    ours = jacobian_determinant(warp.backward, points).reshape(theirs.shape)
    inner = (slice(2, -2),) * 3
    assert theirs[inner].min() > 0.0
    np.testing.assert_allclose(ours[inner], theirs[inner], atol=0.06)  # theirs are differences over 8 mm
    low, high = warp.jacobian
    assert 0.0 < low < 1.0 < high


def test_a_displacement_that_would_fold_is_refused() -> None:
    with pytest.raises(InputError, match="folds the brain"):
        random_warp(np.random.default_rng(0), brain_points_mm(300), 120.0, np.eye(4))


def test_same_seed_same_patient_another_seed_another(warp: SyntheticWarp, patient: SyntheticPatient) -> None:
    again = random_warp(np.random.default_rng(3), brain_points_mm(), 6.0, warp.T_patient_warped)
    np.testing.assert_array_equal(again.backward.coefficients, warp.backward.coefficients)
    assert np.abs(patient.warp.backward.coefficients - warp.backward.coefficients).max() > 1.0


def test_labels_are_the_templates_carried_by_the_map(patient: SyntheticPatient) -> None:
    template = template_labels(template_landmarks())
    points = transform_points(patient.labels.T_patient_voxel, np.argwhere(patient.labels.data >= 0)[::7])
    expected = sample(template, patient.to_template(points), "nearest")
    found = sample(patient.labels, points, "nearest")
    healthy = found != Region.TUMOR
    assert np.mean(found[healthy] == expected[healthy]) > 0.9995  # voxels at a border may round either way
    volumes = [np.count_nonzero(v.data) * np.linalg.det(v.T_patient_voxel[:3, :3]) for v in (patient.labels, template)]
    assert 0.8 < volumes[0] / volumes[1] < 1.25


def test_the_image_follows_the_map_too(head: SyntheticPatient) -> None:
    """Without noise and bias, brain voxels hold the template's brightness, changed by the contrast alone."""
    template = template_t1()
    deep = np.argwhere(head.labels.data > 0)[::50]
    points = transform_points(head.t1.T_patient_voxel, deep)
    source = sample(template, head.to_template(points))
    found = head.t1.data[tuple(deep.T)]
    rank = np.corrcoef(np.argsort(np.argsort(source)), np.argsort(np.argsort(found)))[0, 1]
    assert rank > 0.97  # found is the mean over 2 mm
    assert head.grey_white_ratio < 0.75


def test_tumour_has_no_counterpart(patient: SyntheticPatient) -> None:
    assert patient.tumor is not None
    np.testing.assert_array_equal(patient.tumor.data, patient.labels.data == Region.TUMOR)
    ml = patient.tumor.data.sum() * 12e-3
    assert ml == pytest.approx(np.pi / 6 * 3.0**3, rel=0.15)  # not deformed: as large as asked
    centre = transform_points(patient.tumor.T_patient_voxel, np.argwhere(patient.tumor.data).mean(axis=0))
    np.testing.assert_allclose(centre, patient.to_patient(mm_to_m([TUMOR.center_mm]))[0], atol=mm_to_m(2.0))


def test_tumour_without_room_is_moved_inward_or_refused(patient: SyntheticPatient) -> None:
    brain = patient.labels.data > 0
    top = transform_points(patient.labels.T_patient_voxel, np.argwhere(brain)[np.argwhere(brain)[:, 2].argmax()])
    shallow = m_to_mm(top) - [0.0, 0.0, 10.0]
    _, labels = with_tumor(patient.t1, patient.labels, TumorShape(center_mm=tuple(shallow), diameter_mm=20.0, seed=3))
    added = (labels.data == Region.TUMOR) & (patient.labels.data != Region.TUMOR)
    centre = m_to_mm(transform_points(labels.T_patient_voxel, np.argwhere(added).mean(axis=0)))
    assert 1.0 < np.linalg.norm(centre - shallow) < 12.0
    assert not np.any(added & ~brain)
    with pytest.raises(InputError, match="wholly inside"):
        with_tumor(patient.t1, patient.labels, TumorShape(center_mm=tuple(shallow + np.array([0.0, 0.0, 30.0]))))


def test_septa_are_the_templates_mapped(patient: SyntheticPatient) -> None:
    for ours, theirs in zip(patient.septa, septa_from_landmarks(template_landmarks().septa, 3.0), strict=True):
        assert ours.name == theirs.name
        np.testing.assert_allclose(patient.to_template(ours.surface.vertices), theirs.surface.vertices, atol=mm_to_m(1e-3))


def test_stripped_patient_is_zero_outside_and_noisy_inside(patient: SyntheticPatient) -> None:
    brain = patient.labels.data > 0
    assert not np.any(patient.t1.data[~brain])
    rim = brain & ~ndimage.binary_erosion(brain)
    below = ndimage.binary_erosion(brain) & ~ndimage.binary_erosion(brain, iterations=2)
    assert np.median(patient.t1.data[rim]) > 0.58 * np.median(patient.t1.data[below])  # cut, not faded: 0.64, else 0.53
    assert patient.t1.data[patient.labels.data > 0].mean() == pytest.approx(0.75 * WHITE, rel=0.25)
    assert patient.t1.data.dtype == np.float32
    assert patient.labels.data.dtype == np.uint8


def ring(head: SyntheticPatient, low_mm: float, high_mm: float) -> np.ndarray:
    """Brightness at a distance from the brain over the vault, white matter 1."""
    edges_mm = m_to_mm(np.diag(head.t1.T_patient_voxel)[:3])
    distance = ndimage.distance_transform_edt(head.labels.data == 0, sampling=edges_mm)
    top = transform_points(head.t1.T_patient_voxel, np.moveaxis(np.indices(head.t1.shape), 0, -1))[..., 2] > 0.03
    return head.t1.data[top & (distance > low_mm) & (distance <= high_mm)] / WHITE


def test_layers_of_the_head_are_those_of_a_t1(head: SyntheticPatient) -> None:
    """From the brain outward: dark fluid and bone, bright fat, then air."""
    fluid, bone, scalp, air = ring(head, 0.5, 2.0), ring(head, 3.0, 7.0), ring(head, 11.0, 14.0), ring(head, 35.0, 60.0)
    assert np.median(fluid) < 0.4
    assert np.median(bone) < 0.4
    assert np.percentile(scalp, 75) > 0.9
    assert air.max() == 0.0
    brain = head.labels.data > 0
    assert np.count_nonzero(head.t1.data > 0.05 * WHITE) > 2 * np.count_nonzero(brain)  # a head, not a brain


def test_contrast_is_monotone_and_changes_the_grey_white_ratio() -> None:
    levels = Volume(np.linspace(0.0, 1.1, 300, dtype=np.float32).reshape(300, 1, 1), np.eye(4))
    changed = Contrast(1.8)(levels).data.ravel()
    assert np.all(np.diff(changed) > 0.0)
    grey, white = (np.interp(level, levels.data.ravel(), changed) for level in (0.66, 0.84))
    assert grey / white == pytest.approx(Contrast(1.8).grey_white_ratio, abs=1e-3)
    assert Contrast(1.8).grey_white_ratio < 0.7


def test_noise_is_rician_and_bias_has_its_range() -> None:
    T = np.diag([0.001, 0.001, 0.001, 1.0])
    dark, bright = (Volume(np.full((60, 60, 60), level, np.float32), T) for level in (0.0, WHITE))
    dark.data[0, 0, 0] = WHITE  # some head
    noise = imaged(dark, 0.05, 0.0, np.random.default_rng(0)).data[1:]
    sigma = 0.05 * WHITE
    assert noise.mean() == pytest.approx(sigma * np.sqrt(np.pi / 2), rel=0.01)  # Rayleigh
    assert noise.std() == pytest.approx(sigma * np.sqrt(2 - np.pi / 2), rel=0.01)
    assert imaged(bright, 0.05, 0.0, np.random.default_rng(0)).data.std() == pytest.approx(sigma, rel=0.02)
    biased = imaged(bright, 0.0, 0.2, np.random.default_rng(1)).data / WHITE
    assert np.abs(np.log(biased)).max() == pytest.approx(0.2, abs=1e-4)
    assert np.abs(np.diff(biased, axis=0)).max() < 0.02  # smooth


def test_smooth_noise_and_splines() -> None:
    noise = smooth_noise(np.random.default_rng(0), (160, 150, 140), 4.0)
    assert noise.std() == pytest.approx(1.0, abs=0.05)
    assert abs(noise.mean()) < 0.05
    nodes, matrix = interpolation_matrix(41, 5.0)
    np.testing.assert_allclose(matrix @ (nodes**3 - 2.0 * nodes), np.arange(41.0) ** 3 - 2.0 * np.arange(41.0), atol=1e-6)
    product = tensor_product([np.diag([1.0, 2.0]), np.ones((3, 2)), np.eye(2)], np.arange(8.0).reshape(2, 2, 2))
    np.testing.assert_allclose(product[1, 2], [2 * (4 + 6), 2 * (5 + 7)])
    assert NODE_MM < 16.0 / 2  # the finest width of the velocity is resolved


def test_thick_slices_hold_the_mean_of_thin_ones(head: SyntheticPatient) -> None:
    t1 = head.t1
    thick = thick_slices(t1, 3)
    assert thick.shape == (*t1.shape[:2], t1.shape[2] // 3)
    np.testing.assert_allclose(thick.data[..., 5], t1.data[..., 15:18].mean(axis=2), rtol=1e-5)
    place = transform_points(thick.T_patient_voxel, [4.0, 5.0, 5.0])
    np.testing.assert_allclose(place, transform_points(t1.T_patient_voxel, [4.0, 5.0, 16.0]), atol=1e-12)
    labels = thick_slices(head.labels, 2, labels=True)
    assert set(np.unique(labels.data)) <= set(np.unique(head.labels.data))
    np.testing.assert_allclose(labels.T_patient_voxel, thick_slices(t1, 2).T_patient_voxel)
    np.testing.assert_allclose(block_mean(t1.data[:6, :6, :6], (1, 1, 3)), thick.data[:6, :6, :2], rtol=1e-5)


def test_other_grids_keep_every_place(head: SyntheticPatient) -> None:
    points = transform_points(head.t1.T_patient_voxel, np.argwhere(head.labels.data > 0)[::997])
    before = sample(head.t1, points)
    for changed in (
        reoriented(head.t1, (2, 0, 1), (1, -1, -1)),
        cut_off(head.t1, 0.05, axis=1, side=-1),
        cut_off(head.t1, 0.05, axis=0, side=1),
    ):
        np.testing.assert_allclose(sample(changed, points), before, rtol=1e-4, atol=1e-2)
    turned = oblique(head.t1, Rotation.from_euler("xyz", [20, 10, -15], degrees=True))
    assert np.median(np.abs(sample(turned, points) - before)) < 0.04 * WHITE  # interpolated twice
    corner = transform_points(head.t1.T_patient_voxel, [0.0, 0.0, 0.0])
    index = transform_points(np.linalg.inv(turned.T_patient_voxel), corner)
    assert np.all(index > -0.5)
    labels = oblique(head.labels, Rotation.from_euler("z", 20, degrees=True), labels=True)
    assert np.count_nonzero(labels.data) == pytest.approx(np.count_nonzero(head.labels.data), rel=0.01)


def test_slices_are_cut_off_at_the_end_that_was_named(head: SyntheticPatient) -> None:
    cut = cut_off(head.labels, 0.4, axis=2, side=1)
    assert cut.shape[2] == head.labels.shape[2] - round(0.4 * head.labels.shape[2])
    assert np.any(cut.data[..., -1])
    np.testing.assert_array_equal(cut.T_patient_voxel, head.labels.T_patient_voxel)

"""Where the correspondence is hard: large shifts and turns, holes, instruments, dropouts; and where it must say no."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from simulation_cases import SMALL_SCANNER, scan_case

from brainshift_ros.correspondence.guides import Guides, cells_of_pixels
from brainshift_ros.correspondence.tracking import TrackingOptions, prepare_first, track
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, tangent_frame, transform_points
from brainshift_ros.simulation.cavity import Cavity
from brainshift_ros.simulation.instruments import spatula, suction_tube
from brainshift_ros.simulation.lighting import Lighting
from brainshift_ros.simulation.scanner import Seen, scanner_pose, take_scan
from brainshift_ros.units import m_to_mm, mm_to_m

EXACT = TrackingOptions(tracker_mm=0.0)


def slide(millimetres, degrees):
    """A rigid motion of the cortex: a slide along the surface with a third of it inwards, and a turn in the plane."""
    craniotomy = scan_case(2, 8.0).scene.craniotomy
    center, axis = craniotomy.center, craniotomy.axis
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis)
    along = 0.95 * tangent_frame(axis)[0] - 0.31 * axis
    return lambda points: mm_to_m(millimetres) * along + turn.apply(points - center) - (points - center)


@lru_cache
def first_view():
    first = scan_case(2, 8.0).first
    return prepare_first(first.scan, (first.label == Seen.CORTEX) & first.scan.seen)


def later_scan(shift=None, *, dropouts=0.02, seed=5, **scene):
    case = scan_case(2, 8.0)
    scanner = replace(SMALL_SCANNER, dropout_fraction=dropouts)
    pose = scanner_pose(case.scene.craniotomy, scanner, 12.0, 70.0, 25.0)
    return take_scan(case.scene, case.T_patient_tracker, pose, seed=seed, displacement=shift, scanner=scanner, **scene)


def errors_mm(tracking, shift):
    """Length of each error, millimetres, and the points in the patient frame."""
    T = scan_case(2, 8.0).T_patient_tracker
    at = transform_points(T, tracking.points.points)
    residual = tracking.points.displacements @ T[:3, :3].T - shift(at)
    return m_to_mm(np.linalg.norm(residual, axis=1)), at


def clicked(first, later, shift, count, seed=0):
    """Pairs of pixels that show the same tissue, as a person would click them: within a pixel or two."""
    rng = np.random.default_rng(seed)
    tissue = np.argwhere(np.isfinite(later.material).all(axis=-1) & later.scan.seen)
    tree = cKDTree(later.material[tuple(tissue.T)])
    pairs = []
    for pixel in rng.permutation(np.argwhere((first.label == Seen.CORTEX) & first.scan.seen)):
        distance, index = tree.query(first.material[tuple(pixel)])
        if distance < 0.4e-3 and all(np.linalg.norm(pixel - other) > 35 for other, _ in pairs):
            pairs.append((pixel, tissue[index]))
            if len(pairs) == count:
                break
    first_px, later_px = (np.array(pixels) + rng.normal(0.0, 1.0, (count, 2)) for pixels in zip(*pairs, strict=True))
    return Guides(first_px, later_px)


@pytest.mark.parametrize(("millimetres", "degrees", "least"), [(30.0, 30.0, 20), (10.0, -30.0, 30)])
def test_a_far_slide_with_a_turn_is_found_without_help(millimetres, degrees, least):
    shift = slide(millimetres, degrees)
    tracking = track(first_view(), later_scan(shift).scan, EXACT)
    length, _ = errors_mm(tracking, shift)
    assert len(length) >= least
    assert np.median(length) < 0.4
    assert np.quantile(length, 0.95) < 1.2
    assert length.max() < 3.0


@pytest.mark.parametrize(("millimetres", "degrees"), [(0.0, 60.0), (40.0, 0.0)])
def test_beyond_its_reach_it_says_so_and_three_clicks_help(millimetres, degrees):
    shift = slide(millimetres, degrees)
    later = later_scan(shift)
    alone = track(first_view(), later.scan, EXACT)
    assert len(alone.points.points) == 0
    assert "guides" in alone.warnings[0]
    guided = track(first_view(), later.scan, EXACT, clicked(scan_case(2, 8.0).first, later, shift, 3))
    length, _ = errors_mm(guided, shift)
    assert len(length) >= 20
    assert np.median(length) < 0.5
    assert np.quantile(length, 0.95) < 1.5


def test_sixty_percent_of_the_later_range_missing():
    shift = slide(8.0, 10.0)
    length, _ = errors_mm(track(first_view(), later_scan(shift, dropouts=0.6).scan, EXACT), shift)
    assert len(length) >= 30
    assert np.median(length) < 0.5
    assert np.quantile(length, 0.95) < 1.5


def test_cavity_instruments_and_another_lamp():
    case, shift = scan_case(2, 8.0), slide(8.0, 5.0)
    T_patient_craniotomy = invert_rigid(case.scene.craniotomy.T_craniotomy_patient)
    tip, end, blade, handle = transform_points(
        T_patient_craniotomy,
        np.array([[6e-3, -2e-3, 2e-3], [60e-3, -40e-3, 60e-3], [-14e-3, 12e-3, 8e-3], [-80e-3, 70e-3, 45e-3]]),
    )
    cavity = Cavity((6e-3, -4e-3), 9e-3, 11e-3, seed=3)
    later = later_scan(
        shift,
        cavity=cavity,
        instruments=(suction_tube(tip, end), spatula(blade, handle, case.scene.craniotomy.axis)),
        lighting=Lighting(direction=(0.5, -0.3, 1.0), temperature_k=6500.0, spot_radius_m=35e-3),
    )
    tracking = track(first_view(), later.scan, EXACT)
    length, at = errors_mm(tracking, shift)
    assert len(length) >= 25
    assert np.median(length) < 0.4
    assert np.quantile(length, 0.95) < 1.2
    local = transform_points(case.scene.craniotomy.T_craniotomy_patient, at)
    assert (cavity.beyond_rim_m(local[:, :2]) > -0.5e-3).all()
    assert length[cavity.beyond_rim_m(local[:, :2]) < 4e-3].max(initial=0.0) < 1.5
    # What a point is said to have become is cortex in the later scan, not metal or the wall of the hole.
    ends = transform_points(case.T_patient_tracker, tracking.points.points + tracking.points.displacements)
    shown = later.label[np.isfinite(later.scan.points).all(axis=-1)]
    seen = transform_points(case.T_patient_tracker, later.scan.points[later.scan.seen].astype(np.float64))
    assert (shown[cKDTree(seen).query(ends)[1]] == Seen.CORTEX).mean() > 0.97


def test_half_of_the_cortex_under_a_drape_is_a_one_sided_measurement_and_said_so():
    case = scan_case(2, 8.0)
    covered = case.later.scan.points.copy()
    local = transform_points(case.scene.craniotomy.T_craniotomy_patient @ case.T_patient_tracker, covered.astype(np.float64))
    covered[local[..., 0] > -2e-3] = np.nan
    tracking = track(first_view(), replace(case.later.scan, points=covered), EXACT)
    assert len(tracking.points.points) >= 10
    assert 0.15 < tracking.diagnostics["far_share"] < 0.5
    assert any("farther than 15 mm" in warning for warning in tracking.warnings)
    share = f"{tracking.diagnostics['far_share']:.0%}"
    assert any(share in warning for warning in tracking.warnings)


def test_guides_are_checked():
    pixels = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 20.0]])
    for first, later in (
        (pixels[:2], pixels[:2]),
        (pixels, pixels[:2]),
        (pixels[:, :1], pixels[:, :1]),
        (pixels * np.nan, pixels),
    ):
        with pytest.raises(InputError, match="guides"):
            Guides(first, later)
    with pytest.raises(InputError, match="of 3 pairs"):
        track(first_view(), scan_case(2, 8.0).later.scan, EXACT, Guides(pixels - 500.0, pixels))


def test_a_clicked_pixel_lands_where_its_tissue_is():
    case, grid = scan_case(2, 8.0), first_view().grid
    rng = np.random.default_rng(1)
    pixels = rng.permutation(np.argwhere((case.first.label == Seen.CORTEX) & case.first.scan.seen))[:50]
    cells = cells_of_pixels(case.first.scan, grid, pixels.astype(np.float64))
    T_plane_patient = grid.T_plane_tracker @ invert_rigid(case.T_patient_tracker)
    true = transform_points(T_plane_patient, case.first.current[tuple(pixels.T)])[:, :2]
    distance = m_to_mm(np.linalg.norm(cells * grid.cell_m - true, axis=1))
    assert np.nanquantile(distance, 0.9) < 0.3
    outside = cells_of_pixels(case.first.scan, grid, np.array([[-3.0, 4.0], [10.0, 1e5]]))
    assert np.isnan(outside).all()


def test_wrong_clicks_are_not_believed_against_the_pictures():
    later = scan_case(2, 8.0).later.scan
    rows, columns = later.seen.shape
    first_px = np.array([[0.4 * rows, 0.4 * columns], [0.4 * rows, 0.6 * columns], [0.6 * rows, 0.5 * columns]])
    upside_down = np.array([rows, columns]) - first_px
    tracking = track(first_view(), later, EXACT, Guides(first_px, upside_down))
    assert len(tracking.points.points) < 6
    assert tracking.warnings

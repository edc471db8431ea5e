"""The simulated truth: outside the atlas, smooth, reproducible; targets named by where they lie."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.mechanics.boundary import NodeKind
from brainshift_ros.simulation.targets import MIDLINE_M, target_groups
from brainshift_ros.simulation.truth import direction_between, simulate_truth, smooth_random_field
from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surface import Surface

UP = np.array([0.0, -0.94, -0.34]) / np.hypot(0.94, 0.34)
CENTER = np.array([-0.035, 0.045, 0.050])
#: With the base of the brain uppermost, much of it would bulge through the skull.
HEAD_DOWN = np.array([0.0, 0.0, 1.0])


def _angles_deg(direction, others):
    return np.degrees(np.arccos(np.clip(others @ direction, -1.0, 1.0)))


def test_the_truth_s_orientation_lies_in_the_cone_and_between_the_atlas_s_own():
    atlas = directions_in_cone(UP, np.radians(20.0), 30)
    truth = direction_between(atlas, UP, np.radians(20.0))
    assert _angles_deg(truth, UP[None])[0] <= 16.1
    nearest = _angles_deg(truth, atlas).min()
    spacing = np.median([np.sort(_angles_deg(d, atlas))[1] for d in atlas])
    assert 0.4 * spacing < nearest < spacing


def test_the_random_field_has_unit_variance_and_its_correlation_length():
    rng = np.random.default_rng(0)
    length = 0.03
    origin, apart = np.zeros((1, 3)), np.array([[length, 0.0, 0.0]])
    pairs = np.array([smooth_random_field(np.vstack([origin, apart]), length, rng) for _ in range(4000)])
    assert pairs.std(axis=0) == pytest.approx([1.0, 1.0], abs=0.05)
    assert np.mean(pairs[:, 0] * pairs[:, 1]) == pytest.approx(np.exp(-0.5), abs=0.05)


def test_a_truth_differs_by_seed_and_repeats_by_seed(small_patient):
    first, again, other = (simulate_truth(small_patient, UP, 0.5, seed=seed) for seed in (1, 1, 2))
    # Not to the last bit: the solver's threads add up in an order of their own.
    assert again.solution.displacement == pytest.approx(first.solution.displacement, abs=1e-10)
    assert not np.allclose(first.solution.displacement, other.solution.displacement, atol=1e-5)


def test_displacement_at_the_nodes_is_the_solution(small_patient):
    truth = simulate_truth(small_patient, UP, 0.5, seed=1)
    surface = np.unique(truth.mesh.facets["skull"])
    septa = np.unique(np.concatenate([truth.mesh.facets["falx"].ravel(), truth.mesh.facets["tentorium"].ravel()]))
    nodes = np.setdiff1d(surface, septa)[::20]
    assert truth.displacement_at(truth.mesh.nodes[nodes]) == pytest.approx(truth.solution.displacement[nodes], abs=1e-9)
    with pytest.raises(ValueError, match="not on the truth's mesh"):
        truth.displacement_at(np.array([[0.5, 0.0, 0.0]]))


def test_targets_are_where_their_names_say(small_patient):
    mesh = small_patient.mesh
    groups = target_groups(mesh, CENTER, 0.035)
    assert set(groups) == {"surface", "subsurface", "deep", "tumor_margin", "midline", "contralateral"}
    skull = np.unique(mesh.facets["skull"])
    assert np.isin(groups["surface"], skull).all()
    assert not np.isin(groups["subsurface"], skull).any()
    # Elements below the falx belong to a side by their centroid, so a corner may cross the midline by less than an edge.
    edge = small_patient.quality["edge_median_mm"] / 1000.0
    assert (mesh.nodes[groups["contralateral"], 0] > -edge).all()
    falx = Surface(mesh.nodes, mesh.facets["falx"])
    assert closest_points(falx, mesh.nodes[groups["midline"]]).distance.max() <= MIDLINE_M
    assert len(np.intersect1d(groups["subsurface"], groups["deep"])) == 0


def test_a_truth_s_cortex_may_cross_the_skull_in_the_opening_only(small_patient):
    mesh = small_patient.mesh
    skull = np.unique(mesh.facets["skull"])
    opening = np.zeros(len(mesh.nodes), dtype=bool)
    opening[skull[np.linalg.norm(mesh.nodes[skull] - CENTER, axis=1) <= 0.035]] = True
    free, held = (
        simulate_truth(small_patient, HEAD_DOWN, 0.3, seed=1, skull=model, opening=opening).solution
        for model in ("free_cap", "contact")
    )
    assert (held.kinds == NodeKind.CONTACT).any()
    assert not (free.kinds == NodeKind.CONTACT).any()
    assert not (held.kinds[opening] == NodeKind.CONTACT).any()
    assert not np.allclose(free.displacement, held.displacement, atol=1e-6)

"""Parts of the mesher: flat elements repaired, edge lengths asked for, tissue, quadratic elements on the split mesh."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from skfem import Basis, BilinearForm, ElementTetP2, LinearForm, MeshTet, MeshTet2, condense, solve
from skfem.helpers import dot, grad

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.improve import GOAL_DEG, raise_angles
from brainshift_ros.mesh.patient import PatientModel, Tissue
from brainshift_ros.mesh.quality import dihedral_angles_deg
from brainshift_ros.mesh.sizing import (
    CRANIOTOMY_REFINEMENT,
    TUMOR_REFINEMENT,
    TUMOR_RESOLUTION,
    Craniotomy,
    EdgeLengths,
    edge_length_for,
    effective_radius,
)
from brainshift_ros.mesh.tetmesh import tetrahedron_volumes
from brainshift_ros.mesh.tissue import classify_tissue
from brainshift_ros.surface.facets import face_table
from brainshift_ros.surface.surfacing import surface_of_mask


def grid(steps: int) -> tuple[np.ndarray, np.ndarray]:
    mesh = MeshTet.init_tensor(*[np.linspace(0.0, 1.0, steps + 1)] * 3)
    nodes, elements = mesh.p.T.copy(), mesh.t.T.astype(np.int32)
    negative = tetrahedron_volumes(nodes, elements) < 0
    elements[negative] = elements[negative][:, [1, 0, 2, 3]]
    return nodes, elements


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_flat_elements_are_repaired_and_the_surface_stays(seed: int) -> None:
    nodes, elements = grid(4)
    rng = np.random.default_rng(seed)
    skull = face_table(elements).boundary
    inner = np.setdiff1d(np.arange(len(nodes)), skull)
    spoiled = nodes.copy()
    spoiled[inner] += rng.uniform(-0.09, 0.09, (len(inner), 3))
    # a flat one: a node nearly in the plane of three others of its element
    flat = elements[np.isin(elements[:, 0], inner)][rng.integers(0, np.isin(elements[:, 0], inner).sum())]
    spoiled[flat[0]] += 0.97 * (spoiled[flat[1:]].mean(axis=0) - spoiled[flat[0]])
    if tetrahedron_volumes(spoiled, elements).min() <= 0.0:
        return
    before = dihedral_angles_deg(spoiled, elements).min()
    repaired = raise_angles(spoiled, elements, [skull])
    angles = dihedral_angles_deg(repaired, elements).min(axis=1)
    assert before < GOAL_DEG
    assert angles.min() >= GOAL_DEG
    assert tetrahedron_volumes(repaired, elements).min() > 0.0
    assert tetrahedron_volumes(repaired, elements).sum() == pytest.approx(1.0, rel=0.01)
    # nothing near what was sound has moved
    sound = np.setdiff1d(elements, elements[dihedral_angles_deg(spoiled, elements).min(axis=1) < GOAL_DEG])
    assert (np.linalg.norm(repaired - spoiled, axis=1)[sound] > 0).mean() < 0.5


def test_copies_of_a_doubled_node_move_together() -> None:
    nodes, elements = grid(2)
    centre = int(np.argmin(np.linalg.norm(nodes - 0.5, axis=1)))
    nodes[centre] += [0.0, 0.33, 0.05]
    right = nodes[elements].mean(axis=1)[:, 0] > 0.5
    on_plane = np.flatnonzero(nodes[:, 0] == 0.5)
    copy = np.arange(len(nodes))
    copy[on_plane] = len(nodes) + np.arange(len(on_plane))
    split = np.where(right[:, None], copy[elements], elements)
    doubled = np.vstack([nodes, nodes[on_plane]])
    table = face_table(split)
    assert dihedral_angles_deg(doubled, split).min() < 25.0
    repaired = raise_angles(doubled, split, [table.boundary], goal_deg=25.0)
    assert np.linalg.norm(repaired[centre] - nodes[centre]) > 0.01
    np.testing.assert_array_equal(repaired[on_plane], repaired[copy[on_plane]])
    # the sheet is a plane; nodes leave it by a tenth of an edge at most
    assert np.abs(repaired[on_plane, 0] - 0.5).max() < 0.05


def ball(center: tuple[float, float, float], radius: float) -> object:
    points = np.moveaxis(np.indices((81, 81, 81)), 0, -1) * 0.002 - 0.08
    T = np.diag([0.002, 0.002, 0.002, 1.0])
    T[:3, 3] = -0.08
    return surface_of_mask(np.linalg.norm(points - np.array(center), axis=-1) < radius, T, 0.002)


def test_edges_are_short_at_every_tumour_and_the_craniotomy() -> None:
    tumors = [ball((-0.04, 0.0, 0.0), 0.015), ball((0.04, 0.0, 0.0), 0.012)]
    opening = Craniotomy(np.array([0.0, 0.07, 0.0]), 0.01)
    points = np.array([[-0.04, 0, 0], [0.04, 0, 0], [0.04, 0.012 + 0.015, 0], [0.0, 0.07, 0.005], [0.0, -0.07, 0.0]])
    relative = EdgeLengths(points, tumors, opening)(0.005) / 0.005
    assert relative[:2] == pytest.approx(TUMOR_REFINEMENT)
    assert relative[2] == pytest.approx(0.5 * (1.0 + TUMOR_REFINEMENT), abs=0.02)  # half way of 30 mm
    assert relative[3] == pytest.approx(CRANIOTOMY_REFINEMENT)
    assert relative[4] == 1.0
    # a small tumour asks for edges of its own size
    small = ball((-0.04, 0.0, 0.0), 0.006)
    assert effective_radius(small) == pytest.approx(0.006, rel=0.25)  # the blur of 2 mm shrinks it
    assert EdgeLengths(points[:1], [small], None)(0.012) == pytest.approx(TUMOR_RESOLUTION * effective_radius(small))


def test_what_is_refined_makes_the_rest_coarser() -> None:
    brain = ball((0.0, 0.0, 0.0), 0.07)
    plain = edge_length_for(20_000, brain, ())
    assert edge_length_for(160_000, brain, ()) == pytest.approx(plain / 2.0, rel=0.15)
    tumor = edge_length_for(20_000, brain, [ball((0.03, 0.0, 0.0), 0.015)])
    both = edge_length_for(20_000, brain, [ball((0.03, 0.0, 0.0), 0.015)], Craniotomy(np.array([-0.07, 0.0, 0.0]), 0.03))
    assert plain < tumor < both


def test_tissue_by_a_given_threshold_and_on_a_t2(small_patient: PatientModel, template_case: tuple[Volume, Volume]) -> None:
    t1, _ = template_case
    mesh = small_patient.mesh
    automatic, warnings = classify_tissue(mesh, t1)
    assert warnings == ()
    bright, _ = classify_tissue(mesh, t1, float(np.percentile(t1.data[t1.data > 0], 80)))
    assert 0 < np.count_nonzero(bright == Tissue.WHITE) < np.count_nonzero(automatic == Tissue.WHITE)
    np.testing.assert_array_equal(bright == Tissue.TUMOR, mesh.region == Region.TUMOR)
    inverted = Volume(t1.data.max() - t1.data, t1.T_patient_voxel)
    assert "only on a T1" in classify_tissue(mesh, inverted)[1][0]
    with pytest.raises(InputError, match="intensities run from"):
        classify_tissue(mesh, t1, 10.0 * float(t1.data.max()))


def test_tissue_bears_a_bias_field(small_patient: PatientModel, template_case: tuple[Volume, Volume]) -> None:
    t1, _ = template_case
    x = np.linspace(-1.0, 1.0, t1.shape[1])[None, :, None]
    plain, _ = classify_tissue(small_patient.mesh, t1)
    biased, _ = classify_tissue(small_patient.mesh, Volume(t1.data * (1.0 + 0.1 * x), t1.T_patient_voxel))
    assert np.mean(plain == biased) > 0.9


def test_surface_figures_are_reported(small_patient: PatientModel) -> None:
    quality = small_patient.quality
    assert abs(quality["surface_volume_change_percent"]) < 0.3
    assert quality["laplacian_volume_change_percent"] < -0.3
    assert 0.0 < quality["surface_distance_mm_mean"] < 1.0  # voxels of 2 mm
    assert quality["skull_distance_mm_mean"] < 1.0
    assert quality["tumor_distance_mm_mean"] < 0.8


def test_quadratic_elements_pass_the_patch_test_on_the_split_mesh(small_patient: PatientModel) -> None:
    mesh = small_patient.mesh
    length = float(np.ptp(mesh.nodes))
    straight = MeshTet(mesh.nodes.T / length, mesh.elements.T.astype(np.int64))
    basis = Basis(straight, ElementTetP2())

    def exact(x: np.ndarray) -> np.ndarray:
        return x[0] ** 2 - 2.0 * x[1] * x[2] + 3.0 * x[2] ** 2 + x[0]

    stiffness = BilinearForm(lambda u, v, w: dot(grad(u), grad(v))).assemble(basis)
    load = LinearForm(lambda v, w: -8.0 * v).assemble(basis)  # minus the Laplacian
    wanted = exact(basis.doflocs)
    found = solve(*condense(stiffness, load, x=wanted, D=basis.get_dofs().flatten()))
    assert np.abs(found - wanted).max() < 1e-9 * np.abs(wanted).max()


@pytest.mark.parametrize("name", ["falx", "tentorium"])
def test_edge_midpoints_on_both_sides_of_a_septum_coincide(small_patient: PatientModel, name: str) -> None:
    mesh = small_patient.mesh
    quadratic = MeshTet2.from_mesh(MeshTet(mesh.nodes.T, mesh.elements.T.astype(np.int64)))
    edges = {tuple(edge): number for number, edge in enumerate(np.sort(quadratic.edges.T, axis=1))}
    middles = quadratic.doflocs.T[len(mesh.nodes) :]
    below, above = np.split(mesh.facets[name], 2)
    sides = []
    for facets in (below, above):
        pairs = np.unique(np.sort(facets[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        sides.append(middles[[edges[tuple(pair)] for pair in pairs]])
    assert cKDTree(sides[0]).query(sides[1])[0].max() < 1e-9
    assert cKDTree(sides[1]).query(sides[0])[0].max() < 1e-9

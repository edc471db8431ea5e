"""Gravity solutions against exact ones, and against themselves on other meshes and in other frames."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mechanics_cases import box, brain, column, head, ids, outer_facets, plain, split_box
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.boundary import NodeKind
from brainshift_ros.mechanics.extension import harmonic_extension
from brainshift_ros.mechanics.forward import solve_gravity
from brainshift_ros.mechanics.materials import GRAVITY, Material
from brainshift_ros.mesh.tetmesh import TetMesh

DOWN = np.array([0.0, 0.0, -1.0])
OBLIQUE = np.array([0.1, -0.5, -0.8])
HEIGHT = 0.1


def column_error(n, level):
    """Largest error of the self-weight column relative to its largest sag, and the largest sideways motion."""
    mesh = column(n, HEIGHT)
    solution = solve_gravity(mesh, brain(mesh), DOWN, level, cap_level=0.99)
    E, nu = 2100.0, 0.45
    modulus = E * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))  # uniaxial strain
    z, surface = mesh.nodes[:, 2], level * HEIGHT
    above = np.maximum(z - surface, 0.0)
    exact = -1000.0 * GRAVITY / modulus * ((HEIGHT - surface) * z - 0.5 * above**2)
    assert -exact.min() > 0.004
    return np.abs(solution.displacement[:, 2] - exact).max() / -exact.min(), np.abs(solution.displacement[:, :2]).max()


@pytest.mark.parametrize("level", [0.0, 0.35])
def test_self_weight_column(level):
    coarse, fine = column_error(12, level)[0], column_error(24, level)[0]
    assert fine < 0.01
    assert np.log2(coarse / fine) > 1.3


def test_sides_of_the_column_stay_in_their_planes():
    mesh = column(6, HEIGHT)
    u = solve_gravity(mesh, brain(mesh), DOWN, 0.0, cap_level=0.99).displacement
    assert np.abs(u[mesh.facets["falx"].ravel(), 0]).max() < 1e-16
    assert np.abs(u[mesh.facets["tentorium"].ravel(), 1]).max() < 1e-16


def left_heavy(mesh):
    """Material whose right half weighs nothing in air."""
    left = mesh.nodes[mesh.elements].mean(axis=1)[:, 0] < 0.04
    count = len(mesh.elements)
    return Material(np.full(count, 2100.0), np.full(count, 0.45), np.where(left, 1000.0, 0.0)), left


def test_sides_of_a_septum_slide_past_each_other():
    mesh = split_box()
    material, left = left_heavy(mesh)
    u = solve_gravity(mesh, material, DOWN, 0.0).displacement
    left_nodes, right_nodes = np.unique(mesh.elements[left]), np.unique(mesh.elements[~left])
    assert np.abs(u[right_nodes]).max() < 1e-15
    on_sheet = np.intersect1d(left_nodes, mesh.facets["falx"])
    assert u[on_sheet, 2].min() < -1e-3
    assert np.abs(u[on_sheet, 0]).max() < 1e-15
    # The left half alone, whose wall is a slip surface, moves just so.
    node_of = np.full(len(mesh.nodes), -1)
    node_of[left_nodes] = np.arange(len(left_nodes))
    keep = lambda facets: node_of[facets[np.isin(facets, left_nodes).all(axis=1)]]  # noqa: E731
    half = plain(
        mesh.nodes[left_nodes],
        node_of[mesh.elements[left]].astype(np.int32),
        {name: keep(facets).astype(np.int32) for name, facets in mesh.facets.items()},
        {"brainstem": ids(mesh.nodes[left_nodes][:, 2] == 0.0)},
    )
    alone = solve_gravity(half, material.select(left), DOWN, 0.0).displacement
    np.testing.assert_allclose(u[left_nodes], alone, atol=1e-14)


def test_without_septa_the_load_crosses_the_sheet():
    mesh = split_box()
    material, left = left_heavy(mesh)
    u = solve_gravity(mesh, material, DOWN, 0.0, septa=False).displacement
    assert np.abs(u[np.unique(mesh.elements[~left])]).max() > 1e-3
    _, first, inverse = np.unique(mesh.nodes, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(u, u[first[inverse.ravel()]])  # both copies of a node move together
    nodes, elements = box((4, 4, 4), (0.08,) * 3)
    whole = plain(nodes, elements, {"skull": outer_facets(elements)}, {"brainstem": ids(nodes[:, 2] == 0.0)})
    unsplit = solve_gravity(whole, left_heavy(whole)[0], DOWN, 0.0).displacement
    np.testing.assert_allclose(u[: len(nodes)], unsplit, atol=1e-14)


def test_rim_does_not_leave_the_plane_of_its_sheet():
    mesh = split_box(depth=0.5)
    u = solve_gravity(mesh, left_heavy(mesh)[0], DOWN, 0.0).displacement
    rim = mesh.node_sets["falx_rim"]
    assert np.abs(u[rim, 0]).max() < 1e-15
    assert np.abs(u[rim, 2]).max() > 1e-5


def test_turning_the_whole_problem_turns_the_answer():
    mesh = head(8)
    R = Rotation.from_rotvec([0.4, 1.3, -0.8]).as_matrix()
    turned = dataclasses.replace(mesh, nodes=mesh.nodes @ R.T + np.array([0.3, -0.2, 0.1]))
    for resected in (False, True):
        here = solve_gravity(mesh, brain(mesh), OBLIQUE, 0.4, resected=resected).displacement
        there = solve_gravity(turned, brain(mesh), R @ OBLIQUE, 0.4, resected=resected).displacement
        np.testing.assert_allclose(there, here @ R.T, atol=1e-9 * np.abs(here).max())


def test_stiffness_scales_sag_inversely():
    mesh = head(6)
    once, material = solve_gravity(mesh, brain(mesh), OBLIQUE, 0.4), brain(mesh)
    double = dataclasses.replace(material, youngs_modulus=2.0 * material.youngs_modulus)
    np.testing.assert_allclose(2.0 * solve_gravity(mesh, double, OBLIQUE, 0.4).displacement, once.displacement, atol=1e-12)
    assert once.residual < 1e-10
    assert not once.warnings


def test_covered_brain_floats():
    mesh = head(6)
    assert np.all(solve_gravity(mesh, brain(mesh), OBLIQUE, 1.0).displacement == 0.0)


def test_superlu_equals_pardiso():
    mesh = head(6)
    solutions = {
        name: solve_gravity(mesh, brain(mesh), OBLIQUE, 0.4, resected=True, solver=name) for name in ("scipy", "pardiso")
    }
    assert {s.solver for s in solutions.values()} == {"scipy", "pardiso"}
    scale = np.abs(solutions["scipy"].displacement).max()
    np.testing.assert_allclose(solutions["scipy"].displacement, solutions["pardiso"].displacement, atol=1e-10 * scale)


def test_resection_equals_a_mesh_without_the_tumour():
    mesh = head(10)
    kept = mesh.region != Region.TUMOR
    used = np.unique(mesh.elements[kept])
    node_of = np.full(len(mesh.nodes), -1)
    node_of[used] = np.arange(len(used))
    rest = TetMesh(
        mesh.nodes[used],
        node_of[mesh.elements[kept]].astype(np.int32),
        mesh.region[kept],
        {name: node_of[facets].astype(np.int32) for name, facets in mesh.facets.items()},  # the tumour lies inside
        {name: node_of[nodes].astype(np.int32) for name, nodes in mesh.node_sets.items()},
    )
    assert min(facets.min() for facets in rest.facets.values()) >= 0
    resected = solve_gravity(mesh, brain(mesh), OBLIQUE, 0.4, resected=True)
    alone = solve_gravity(rest, brain(rest), OBLIQUE, 0.4)
    np.testing.assert_allclose(resected.displacement[used], alone.displacement, atol=1e-13)
    wall = np.intersect1d(used, mesh.elements[~kept])
    inside = np.setdiff1d(mesh.elements[~kept], used)
    assert len(inside) > 0
    assert set(resected.kinds[np.setdiff1d(wall, mesh.facets["falx"])]) == {NodeKind.CAVITY}
    low, high = resected.displacement[wall].min(axis=0), resected.displacement[wall].max(axis=0)
    assert np.all((resected.displacement[inside] >= low) & (resected.displacement[inside] <= high))


def test_resection_without_septa_equals_an_unsplit_head():
    split, whole = head(8), head(8, sheet=False)
    joined = solve_gravity(split, brain(split), OBLIQUE, 0.4, resected=True, septa=False).displacement
    unsplit = solve_gravity(whole, brain(whole), OBLIQUE, 0.4, resected=True).displacement
    np.testing.assert_allclose(joined[: len(whole.nodes)], unsplit, atol=1e-13)


def test_orientation_that_leaves_no_cap_or_no_slip():
    mesh = head(6, sheet=False)
    sag = {}
    slip, free = NodeKind.SLIP, NodeKind.FREE
    for cap_level, kinds in ((1.0, {slip}), (0.75, {slip, free}), (-0.1, {free})):
        solution = solve_gravity(mesh, brain(mesh), OBLIQUE, 0.4, cap_level=cap_level)
        assert set(solution.kinds) == {NodeKind.INTERIOR, NodeKind.FIXED, *kinds}
        sag[cap_level] = np.abs(solution.displacement).max()
    assert 0.0 < sag[1.0] < sag[0.75] < sag[-0.1]


def test_extension_continues_a_linear_field_exactly():
    nodes, elements = box((4, 4, 4), jiggle=0.2)
    known = ~np.all(np.abs(nodes - 0.5) < 0.4, axis=1)
    field = nodes @ np.array([[1.0, 2, 3], [0, -1, 1], [4, 0, 2]]) + 1.0
    extended = harmonic_extension(plain(nodes, elements), known, "scipy")(np.where(known[:, None], field, np.nan))
    np.testing.assert_allclose(extended, field, atol=1e-12)


def test_pieces_that_lose_their_hold_with_the_tumour_are_reported():
    nodes, elements = box((2, 2, 4), (0.04, 0.04, 0.08))
    middle = nodes[elements].mean(axis=1)[:, 2]
    region = np.where((middle > 0.04) & (middle < 0.06), Region.TUMOR, Region.LEFT_CEREBRUM).astype(np.uint8)
    mesh = plain(nodes, elements, {"skull": outer_facets(elements)}, {"brainstem": ids(nodes[:, 2] == 0.0)}, region)
    solution = solve_gravity(mesh, brain(mesh), DOWN, 0.0, resected=True)
    assert len(solution.warnings) == 1
    assert "24 elements lost their hold" in solution.warnings[0]
    assert np.isfinite(solution.displacement).all()


def test_meshes_that_cannot_be_solved_are_refused():
    mesh = head(6)
    material = brain(mesh)
    no_tumour = dataclasses.replace(mesh, region=np.ones_like(mesh.region))
    cases = [
        (dataclasses.replace(mesh, node_sets={}), material, {}, "brainstem node set is empty"),
        (dataclasses.replace(mesh, elements=mesh.elements[:, [1, 0, 2, 3]]), material, {}, "no positive volume"),
        (mesh, material.select(np.arange(10)), {}, "it has 10 elements"),
        (no_tumour, material, {"resected": True}, "no tumour"),
    ]
    far = mesh.nodes[mesh.elements[0]] + 1.0
    loose = dataclasses.replace(
        mesh,
        nodes=np.concatenate([mesh.nodes, far]),
        elements=np.concatenate([mesh.elements, len(mesh.nodes) + np.arange(4, dtype=np.int32)[None]]),
        region=np.append(mesh.region, mesh.region[:1]),
    )
    cases.append((loose, brain(loose), {}, "1 elements share no face"))
    for bad_mesh, bad_material, options, words in cases:
        with pytest.raises(InputError, match=words):
            solve_gravity(bad_mesh, bad_material, OBLIQUE, 0.4, **options)

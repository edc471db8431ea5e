"""Normals, local frames, slip and free nodes, derived meshes."""

from __future__ import annotations

import numpy as np
import pytest
from mechanics_cases import box, brain, facets_where, head, ids, outer_facets, plain, split_box

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.boundary import NodeKind, boundary_of, constrained_dofs, in_cap, node_kinds
from brainshift_ros.mechanics.faces import ElementFaces
from brainshift_ros.mechanics.frames import nodal_normals
from brainshift_ros.mechanics.heights import height_over_level
from brainshift_ros.mechanics.space import space_of
from brainshift_ros.mechanics.submesh import join_septa, remove_elements, unsupported_elements
from brainshift_ros.mechanics.system import assemble_system

DOWN = np.array([0.0, 0.0, -1.0])


def test_normals_of_a_sphere_are_radial():
    mesh = head(10, radius=0.07, sheet=False)
    normals, present = nodal_normals(mesh.nodes, mesh.facets["skull"])
    radial = mesh.nodes[present] / np.linalg.norm(mesh.nodes[present], axis=1, keepdims=True)
    cosine = np.sum(normals[present] * radial, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 12.0  # the projected cube's corners are the worst
    assert np.all(normals[~present] == 0.0)


def test_normals_are_weighted_by_area():
    # Two facets at a right angle, one four times the other: the normal leans to the large one.
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 4, 0], [0, 0, 1]])
    facets = np.array([[0, 1, 2], [0, 3, 1]], np.int32)  # areas 2 (normal z) and 0.5 (normal y)
    normals, _ = nodal_normals(nodes, facets)
    np.testing.assert_allclose(normals[0], np.array([0.0, 0.5, 2.0]) / np.hypot(0.5, 2.0), atol=1e-15)


def test_frames_are_orthonormal_and_identity_inside():
    mesh = head(8)
    boundary = boundary_of(space_of(mesh))
    eye = np.broadcast_to(np.eye(3), boundary.frames.shape)
    np.testing.assert_allclose(np.einsum("nai,nbi->nab", boundary.frames, boundary.frames), eye, atol=1e-14)
    untouched = ~boundary.always_slip.any(axis=1) & (boundary.skull_axis < 0)
    assert np.count_nonzero(untouched) > 100
    np.testing.assert_array_equal(boundary.frames[untouched], eye[untouched])


def test_septum_comes_first_and_the_skull_normal_is_made_orthogonal():
    mesh = split_box()
    boundary = boundary_of(space_of(mesh))
    x, _, z = mesh.nodes.T
    crest = np.isclose(x, 0.04) & np.isclose(z, 0.08)
    assert np.count_nonzero(crest) == 10  # five nodes, doubled
    np.testing.assert_allclose(np.abs(boundary.frames[crest, 0]), np.tile([1.0, 0, 0], (10, 1)), atol=1e-14)
    assert set(boundary.skull_axis[crest]) == {1}
    np.testing.assert_allclose(boundary.frames[crest, 1, 0], 0.0, atol=1e-14)
    # The two sides of the sheet have opposite outward normals.
    rightward = boundary.frames[:, 0, 0] > 0.0
    np.testing.assert_array_equal(mesh.nodes[crest & rightward], mesh.nodes[crest & ~rightward])


def test_oblique_skull_is_orthogonalised_and_a_parallel_one_dropped():
    nodes = np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0.0, 1.0], [0.1, 0.0, 1.0]])
    wall = np.array([[0, 1, 2]], np.int32)  # normal +x

    def skull_axis(tip):
        facets = {"falx": wall, "skull": np.array([[0, 1, tip]], np.int32)}
        boundary = boundary_of(space_of(plain(nodes, np.array([[0, 1, 2, 3]]), facets)))
        return boundary.skull_axis[0], boundary.frames[0]

    axis, frame = skull_axis(3)  # 45 degrees to the sheet
    assert axis == 1
    np.testing.assert_allclose(np.abs(frame[:2]), [[1, 0, 0], [0, 0, 1]], atol=1e-15)
    assert skull_axis(4)[0] == -1  # 6 degrees to the sheet: one surface


def test_falx_and_tentorium_and_skull_hold_three_directions():
    nodes, elements = box((2, 2, 2))
    outer = outer_facets(elements)
    facets = {
        name: facets_where(nodes, outer, lambda x, axis=axis: np.isclose(x[..., axis], 0.0))
        for axis, name in enumerate(("falx", "tentorium", "skull"))
    }
    boundary = boundary_of(space_of(plain(nodes, elements, facets)))
    corner = ids(np.all(nodes == 0.0, axis=1))[0]
    np.testing.assert_array_equal(boundary.always_slip[corner], [True, True, False])
    assert boundary.skull_axis[corner] == 2
    np.testing.assert_allclose(np.abs(boundary.frames[corner]), np.eye(3), atol=1e-15)


def test_rim_is_held_normal_to_the_sheet():
    mesh = split_box(depth=0.5)
    boundary = boundary_of(space_of(mesh))
    rim = mesh.node_sets["falx_rim"]
    assert len(rim) == 5
    np.testing.assert_allclose(np.abs(boundary.frames[rim, 0]), np.tile([1.0, 0, 0], (5, 1)), atol=1e-12)
    assert boundary.always_slip[rim, 0].all()


def test_cap_frees_the_skull_normal_and_nothing_else():
    mesh = split_box()
    boundary = boundary_of(space_of(mesh))
    cap = in_cap(mesh.nodes, DOWN, 0.8)
    held = constrained_dofs(boundary, cap)
    free_held = constrained_dofs(boundary, np.zeros(len(cap), bool))
    changed = free_held & ~held
    np.testing.assert_array_equal(ids(changed.any(axis=1)), ids(cap & (boundary.skull_axis >= 0)))
    crest = np.isclose(mesh.nodes[:, 0], 0.04) & cap
    assert held[crest, 0].all()
    kinds = node_kinds(boundary, cap)
    z = mesh.nodes[:, 2]
    assert set(kinds[z == 0.0]) == {NodeKind.FIXED}
    assert set(kinds[np.isclose(z, 0.08)]) == {NodeKind.FREE}
    assert set(kinds[(boundary.skull_axis >= 0) & ~cap & (z > 0)]) == {NodeKind.SLIP}
    assert kinds[ids(np.all(np.isclose(mesh.nodes, [0.02, 0.04, 0.04]), axis=1))] == [NodeKind.INTERIOR]


def test_levels_are_fractions_of_the_extent_along_up():
    nodes = np.array([[0.0, -0.1, 5.0], [0.0, 0.1, -5.0], [0.0, 0.05, 0.0]])
    np.testing.assert_allclose(height_over_level(nodes, [0.0, -2.0, 0.0], 0.5), [-0.1, 0.1, 0.05], atol=1e-15)


def test_level_that_is_no_number_is_refused():
    with pytest.raises(InputError, match="level: is nan"):
        height_over_level(np.zeros((2, 3)), [0.0, 0.0, -1.0], np.nan)


@pytest.mark.parametrize("direction", [[0, 0, 0], [np.nan, 0, 1], [1.0, 0.0]])
def test_bad_direction_is_refused(direction):
    with pytest.raises(InputError, match="gravity direction"):
        height_over_level(np.zeros((2, 3)), direction, 0.5)


def test_orientation_tells_the_owner_of_an_inner_facet():
    elements = box((2, 1, 1))[1]
    faces = ElementFaces(elements)
    for element in (0, 3):
        outward = elements[element][[1, 2, 3]]
        assert faces.owners(outward[None]) == [element]
        assert faces.owners(outward[[1, 2, 0]][None]) == [element]
        assert faces.owners(outward[::-1][None]) != [element]
    assert faces.owners(np.array([[0, 0, 0]])) == [-1]


def test_removing_elements_takes_their_facets_and_nodes():
    mesh = head(8)
    removed = mesh.region == Region.TUMOR
    rest = remove_elements(mesh, removed)
    assert len(rest.mesh.elements) == np.count_nonzero(~removed)
    np.testing.assert_array_equal(rest.mesh.nodes[rest.mesh.elements], mesh.nodes[mesh.elements[~removed]])
    np.testing.assert_array_equal(ids(rest.node_of < 0), np.setdiff1d(mesh.elements[removed], mesh.elements[~removed]))
    np.testing.assert_array_equal(rest.node_of[rest.parent_node], np.arange(len(rest.mesh.nodes)))
    for name in ("skull", "falx"):
        assert (ElementFaces(rest.mesh.elements).owners(rest.mesh.facets[name]) >= 0).all()


def test_joining_the_septa_undoes_the_split():
    split = split_box(depth=0.5)
    joined = join_septa(split)
    nodes, _ = box((4, 4, 4), (0.08,) * 3)
    assert len(joined.mesh.nodes) == len(nodes) < len(split.nodes)
    np.testing.assert_array_equal(joined.mesh.nodes[joined.node_of], split.nodes)
    assert set(joined.mesh.facets) == {"skull"}
    assert set(joined.mesh.node_sets) == {"brainstem"}
    assert len(outer_facets(joined.mesh.elements)) == len(joined.mesh.facets["skull"])


def test_parts_that_hang_by_an_edge_are_unsupported():
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, 0, 1]])
    elements = np.array([[0, 1, 2, 3], [1, 3, 4, 5]], np.int32)  # they share the edge 1-3 only
    mesh = plain(nodes, elements, node_sets={"brainstem": np.array([0, 1, 2], np.int32)})
    np.testing.assert_array_equal(unsupported_elements(mesh, np.zeros(2, bool)), [False, True])


def test_walls_that_resection_opens_are_named():
    mesh = head(8)
    removed = mesh.region == Region.TUMOR
    rest = remove_elements(mesh, removed)
    wall = rest.parent_node[rest.mesh.facets["cavity"]]
    assert (ElementFaces(mesh.elements[removed]).owners(wall[:, ::-1]) >= 0).all()  # they point into the cavity
    assert (ElementFaces(rest.mesh.elements).owners(rest.mesh.facets["cavity"]) >= 0).all()
    shared = np.intersect1d(mesh.elements[removed], mesh.elements[~removed])
    np.testing.assert_array_equal(np.unique(wall), shared)
    assert "cavity" not in remove_elements(mesh, np.zeros_like(removed)).mesh.facets


def test_quadratic_nodes_are_the_middles_of_the_edges():
    mesh = head(6)
    space = space_of(mesh, "P2")
    pairs = np.unique(
        np.sort(mesh.elements[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2), axis=1), axis=0
    )
    assert len(space) == len(mesh.nodes) + len(pairs)
    np.testing.assert_array_equal(space.points[: len(mesh.nodes)], mesh.nodes)
    np.testing.assert_allclose(space.points[len(mesh.nodes) :], mesh.nodes[space.edges].mean(axis=1), atol=1e-17)
    for corners in space.facets.values():
        for column, (i, j) in enumerate([(0, 1), (1, 2), (2, 0)], start=3):
            middle = space.points[corners[:, [i, j]]].mean(axis=1)
            np.testing.assert_allclose(space.points[corners[:, column]], middle, atol=1e-17)
    np.testing.assert_allclose(space.basis.doflocs[:, ::3].T, space.points, atol=1e-16)
    np.testing.assert_array_equal(space.basis.element_dofs[::3].T, 3 * space.elements)


def test_mid_edges_are_doubled_on_a_sheet_and_shared_on_its_rim():
    space = space_of(split_box(depth=0.5), "P2")
    points, copies = np.unique(space.points.round(12), axis=0, return_counts=True)
    on_plane, z = np.isclose(points[:, 0], 0.04), points[:, 2]
    assert set(copies[on_plane & (z > 0.04 + 1e-9)]) == {2}
    assert set(copies[on_plane & (z < 0.04 + 1e-9)]) == {1}
    assert set(copies[~on_plane]) == {1}
    boundary = boundary_of(space)
    rim = space.node_sets["falx_rim"]
    assert len(rim) == 9
    np.testing.assert_allclose(np.abs(boundary.frames[rim, 0]), np.tile([1.0, 0, 0], (9, 1)), atol=1e-12)
    assert boundary.always_slip[rim, 0].all()


def test_mid_edges_are_fixed_and_slip_as_their_surfaces_do():
    space = space_of(split_box(), "P2")
    boundary = boundary_of(space)
    x, y, z = space.points.T
    np.testing.assert_array_equal(boundary.fixed, np.isclose(z, 0.0))
    held = constrained_dofs(boundary, in_cap(space.mesh.nodes, DOWN, 0.8, space.points))
    middle = np.arange(len(space)) >= space.vertex_count
    wall = middle & np.isclose(y, 0.0) & (x > 1e-9) & (x < 0.08 - 1e-9) & ~np.isclose(x, 0.04) & (z > 1e-9) & (z < 0.06)
    assert np.count_nonzero(wall) > 10
    np.testing.assert_allclose(boundary.frames[wall, 0], np.tile([0.0, -1.0, 0.0], (wall.sum(), 1)), atol=1e-15)
    np.testing.assert_array_equal(held[wall], np.tile([True, False, False], (wall.sum(), 1)))
    np.testing.assert_array_equal(
        held[middle & np.isclose(z, 0.08) & (x > 0.041) & (x < 0.079) & (y > 1e-9) & (y < 0.079)], False
    )


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_contact_bounds_what_the_free_cap_frees(element):
    mesh = head(8)
    system = assemble_system(mesh, brain(mesh), element=element)
    boundary = system.boundary
    held, one_sided = system.held_and_one_sided(DOWN, 0.6)
    assert not (held & one_sided).any()
    np.testing.assert_array_equal(held, system.constrained(DOWN, 0.6))
    np.testing.assert_array_equal(held | one_sided, system.constrained(DOWN, 1.0))
    node, axis = np.nonzero(one_sided.reshape(-1, 3))
    np.testing.assert_array_equal(axis, boundary.skull_axis[node])
    assert (np.sum(boundary.frames[node, axis] * system.space.points[node], axis=1) > 0.0).all()  # outward is positive
    opening = np.zeros(len(mesh.nodes), bool)
    opening[mesh.facets["skull"][mesh.nodes[mesh.facets["skull"]].min(axis=1)[:, 1] > 0.0]] = True
    held_open, one_sided_open = system.held_and_one_sided(DOWN, 0.6, opening)
    free = (held | one_sided) & ~(held_open | one_sided_open)
    assert set(np.flatnonzero(free.reshape(-1, 3).any(axis=1))) == set(
        np.flatnonzero(system.space.spread(opening) & (boundary.skull_axis >= 0) & ~boundary.fixed)
    )


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_surfaces_above_a_level_are_drained(element):
    mesh = head(8)
    system = assemble_system(mesh, brain(mesh), resected=True, element=element)
    nodes = system.submesh.mesh.nodes
    outer, wall = (np.zeros(len(nodes), bool) for _ in range(2))
    outer[system.submesh.mesh.facets["skull"]] = wall[system.submesh.mesh.facets["cavity"]] = True
    above = height_over_level(mesh.nodes, DOWN, 0.55, nodes) > 0.0
    assert (wall & above).any()
    assert (wall & ~above).any()
    np.testing.assert_array_equal(system.drained(DOWN, 0.55), (outer | wall) & above)
    np.testing.assert_array_equal(system.drained(DOWN, 0.55, cavity=False), outer & above)
    np.testing.assert_array_equal(system.stress_free(DOWN, 0.55), (outer & above) | wall)

"""Normals, local frames, slip and free nodes, derived meshes."""

from __future__ import annotations

import numpy as np
import pytest
from mechanics_cases import box, facets_where, head, ids, outer_facets, plain, split_box

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.boundary import NodeKind, boundary_of, constrained_dofs, in_cap, nodal_normals, node_kinds
from brainshift_ros.mechanics.heights import height_over_level
from brainshift_ros.mechanics.submesh import facet_owners, join_septa, remove_elements, unsupported_elements

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
    boundary = boundary_of(mesh)
    eye = np.broadcast_to(np.eye(3), boundary.frames.shape)
    np.testing.assert_allclose(np.einsum("nai,nbi->nab", boundary.frames, boundary.frames), eye, atol=1e-14)
    untouched = ~boundary.always_slip.any(axis=1) & (boundary.skull_axis < 0)
    assert np.count_nonzero(untouched) > 100
    np.testing.assert_array_equal(boundary.frames[untouched], eye[untouched])


def test_septum_comes_first_and_the_skull_normal_is_made_orthogonal():
    mesh = split_box()
    boundary = boundary_of(mesh)
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
        boundary = boundary_of(
            plain(nodes, np.array([[0, 1, 2, 3]]), {"falx": wall, "skull": np.array([[0, 1, tip]], np.int32)})
        )
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
    boundary = boundary_of(plain(nodes, elements, facets))
    corner = ids(np.all(nodes == 0.0, axis=1))[0]
    np.testing.assert_array_equal(boundary.always_slip[corner], [True, True, False])
    assert boundary.skull_axis[corner] == 2
    np.testing.assert_allclose(np.abs(boundary.frames[corner]), np.eye(3), atol=1e-15)


def test_rim_is_held_normal_to_the_sheet():
    mesh = split_box(depth=0.5)
    boundary = boundary_of(mesh)
    rim = mesh.node_sets["falx_rim"]
    assert len(rim) == 5
    np.testing.assert_allclose(np.abs(boundary.frames[rim, 0]), np.tile([1.0, 0, 0], (5, 1)), atol=1e-12)
    assert boundary.always_slip[rim, 0].all()


def test_cap_frees_the_skull_normal_and_nothing_else():
    mesh = split_box()
    boundary = boundary_of(mesh)
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
    for element, faces in ((0, elements[0]), (3, elements[3])):
        outward = faces[[1, 2, 3]]
        assert facet_owners(elements, outward[None]) == [element]
        assert facet_owners(elements, outward[[1, 2, 0]][None]) == [element]
        assert facet_owners(elements, outward[::-1][None]) != [element]
    assert facet_owners(elements, np.array([[0, 0, 0]])) == [-1]


def test_removing_elements_takes_their_facets_and_nodes():
    mesh = head(8)
    removed = mesh.region == Region.TUMOR
    rest = remove_elements(mesh, removed)
    assert len(rest.mesh.elements) == np.count_nonzero(~removed)
    np.testing.assert_array_equal(rest.mesh.nodes[rest.mesh.elements], mesh.nodes[mesh.elements[~removed]])
    np.testing.assert_array_equal(ids(rest.node_of < 0), np.setdiff1d(mesh.elements[removed], mesh.elements[~removed]))
    np.testing.assert_array_equal(rest.node_of[rest.parent_node], np.arange(len(rest.mesh.nodes)))
    for name in ("skull", "falx"):
        assert (facet_owners(rest.mesh.elements, rest.mesh.facets[name]) >= 0).all()


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

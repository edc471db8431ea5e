"""Surfaces that move with the tissue and their files; the gap and the cavity that tissue leaves."""

from __future__ import annotations

from dataclasses import replace

import meshio
import numpy as np
import pytest
import pyvista as pv
from field_cases import box_mesh, ellipsoid_mesh, smooth_field, split_box

from brainshift_ros.errors import InputError
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.surfaces import read_surface, warp_part, warp_surface, write_surface
from brainshift_ros.field.vacated import draw_cavity, draw_gap
from brainshift_ros.field.warp import warp_image
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.nearest import boundary_faces
from brainshift_ros.surface.surface import Surface

MESH = ellipsoid_mesh(8)
SKIN, _ = boundary_faces(MESH.elements)
FIELD = smooth_field(replace(MESH, facets={"skull": SKIN.astype(np.int32), "tumor": np.zeros((0, 3), np.int32)}))
DEFORMATION = Deformation(FIELD)


def test_parts_of_the_mesh_move_by_their_nodes():
    moved = warp_part(DEFORMATION, "brain")
    outer = np.unique(SKIN)
    np.testing.assert_array_equal(moved.surface.vertices, DEFORMATION.deformed_nodes[outer])
    np.testing.assert_array_equal(outer[moved.surface.faces], SKIN)
    np.testing.assert_array_equal(moved.std, FIELD.std[outer])
    np.testing.assert_allclose(moved.surface.vertices - moved.displacement, MESH.nodes[outer], atol=1e-15)


def test_both_sides_of_a_septum_come_with_their_own_motion():
    mesh, left_nodes = split_box(n=2)
    faces, _ = boundary_faces(mesh.elements)
    sheet = faces[(mesh.nodes[faces][:, :, 0] == 0.0).all(axis=1)]
    u = np.zeros_like(mesh.nodes)
    u[:left_nodes, 1] = 0.005
    split = replace(mesh, facets={"falx": sheet.astype(np.int32)})
    moved = warp_part(Deformation(DisplacementField(split, u, np.zeros(len(u)), {})), "falx")
    assert sorted(set(moved.displacement[:, 1])) == [0.0, 0.005]
    assert len(moved.surface.faces) == len(sheet) == 16


def test_a_missing_part_is_named():
    with pytest.raises(InputError, match=r"surface tumor: is not in the field's mesh.*\(brain\)"):
        warp_part(DEFORMATION, "tumor")


def test_any_surface_moves_with_the_tissue():
    moved = warp_surface(DEFORMATION, Surface(MESH.nodes * 1.002, SKIN.astype(np.int32)))
    outer = np.unique(SKIN)
    np.testing.assert_allclose(moved.surface.vertices[outer], 1.002 * MESH.nodes[outer] + FIELD.displacement[outer], atol=4e-4)
    np.testing.assert_allclose(moved.std[outer], FIELD.std[outer], rtol=0.05)
    far = warp_surface(DEFORMATION, Surface(3.0 * MESH.nodes, SKIN.astype(np.int32)))
    assert np.isnan(far.std[outer]).all()


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "ply", "stl", "obj"])
def test_files_hold_millimetres_as_another_reader_sees_them(tmp_path, suffix):
    path = tmp_path / f"brain.{suffix}"
    moved = warp_part(DEFORMATION, "brain")
    write_surface(path, moved)
    theirs = pv.read(path)
    vertices = 1e3 * moved.surface.vertices
    np.testing.assert_allclose(theirs.bounds, np.stack([vertices.min(axis=0), vertices.max(axis=0)], 1).ravel(), atol=1e-3)
    assert theirs.n_cells == len(moved.surface.faces)
    if suffix not in ("stl", "obj"):
        data = meshio.read(path).point_data if suffix == "ply" else theirs  # VTK reads no vertex data of PLY
        np.testing.assert_allclose(data["shift_mm"], 1e3 * np.linalg.norm(moved.displacement, axis=1), atol=1e-4)
        np.testing.assert_allclose(data["std_mm"], 1e3 * moved.std, atol=1e-4)
    ours = read_surface(path)
    corners = ours.vertices[ours.faces]
    np.testing.assert_allclose(corners, moved.surface.vertices[moved.surface.faces], atol=1e-6)


def test_other_files_are_no_surfaces(tmp_path):
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(InputError, match="cannot be read as a surface"):
        read_surface(tmp_path / "text.ply")
    meshio.write(tmp_path / "line.vtu", meshio.Mesh(np.eye(3), [("line", [[0, 1]])]))
    with pytest.raises(InputError, match="holds no triangles"):
        read_surface(tmp_path / "line.vtu")
    meshio.write(tmp_path / "nan.vtu", meshio.Mesh(np.full((3, 3), np.nan), [("triangle", [[0, 1, 2]])]))
    with pytest.raises(InputError, match="not finite"):
        read_surface(tmp_path / "nan.vtu")
    with pytest.raises(InputError, match=r"does not end in \.vtu or"):
        write_surface(tmp_path / "brain.xyz", warp_part(DEFORMATION, "brain"))


def head():
    """A brain that sinks by 6 mm, in a head whose skull is 200, its fluid 30, its brain 100."""
    mesh = box_mesh((4, 4, 4), (-0.03, -0.03, -0.03), (0.03, 0.03, 0.03))
    region = np.where((np.abs(mesh.nodes[mesh.elements].mean(axis=1)) < 0.015).all(axis=1), Region.TUMOR, Region.LEFT_CEREBRUM)
    mesh = replace(mesh, region=region.astype(np.uint8))
    sinking = np.tile([0.0, -0.006, 0.0], (len(mesh.nodes), 1))
    T = np.diag([0.003, 0.003, 0.003, 1.0])
    T[:3, 3] = -0.0435
    x = np.abs(Grid((30, 30, 30), T).centres(np.moveaxis(np.indices((30, 30, 30)), 0, -1))).max(axis=-1)
    image = Volume(np.select([x < 0.03, x < 0.037], [100, 30], 200).astype(np.int16), T)
    return Deformation(DisplacementField(mesh, sinking, np.zeros(len(sinking)), {})), image


def test_the_skull_stays_and_the_gap_beneath_it_is_drawn():
    deformation, image = head()
    warped = warp_image(deformation, image)
    owner = deformation.owner_now(warped.grid)
    drawn = draw_gap(warped.volume, image, deformation, owner, 5.0).data
    before, now = deformation.inside(warped.grid), owner >= 0
    assert (drawn[before & ~now] == 5).all()
    assert np.count_nonzero(before & ~now) == 2 * 20 * 20  # 6 mm of a 60 mm cube's side, in voxels of 3 mm
    np.testing.assert_array_equal(drawn[~before & ~now], image.data[~before & ~now])
    np.testing.assert_array_equal(drawn[now], warped.volume.data[now])
    assert (drawn[now] == 100).mean() > 0.9
    assert not np.array_equal(warped.volume.data[~before & ~now], image.data[~before & ~now]), "else nothing was carried along"


def test_the_outermost_voxels_of_the_brain_move_with_it():
    # The image shows brain 1.2 mm beyond the mesh; none of it may be left behind as specks.
    deformation, _ = head()
    T = np.diag([0.0012, 0.0012, 0.0012, 1.0])
    T[:3, 3] = -0.042
    x = np.abs(Grid((71, 71, 71), T).centres(np.moveaxis(np.indices((71, 71, 71)), 0, -1))).max(axis=-1)
    image = Volume(np.where(x < 0.0318, 100, 0).astype(np.int16), T)
    warped = warp_image(deformation, image)
    drawn = draw_gap(warped.volume, image, deformation, deformation.owner_now(warped.grid), 0.0).data
    lit = warped.grid.centres(np.argwhere(drawn > 50))
    away_from_corners = (np.abs(lit[:, [0, 2]]) < 0.02).all(axis=1)
    np.testing.assert_allclose(lit[away_from_corners, 1].max(), 0.0312 - 0.006, atol=0.0013)


def test_the_cavity_is_where_the_walls_of_the_tumour_are_now():
    deformation, image = head()
    warped = warp_image(deformation, image)
    owner = deformation.owner_now(warped.grid)
    drawn = draw_cavity(warped.volume, deformation, owner, -7.0).data
    now = warped.grid.centres(np.argwhere(drawn == -7)).mean(axis=0)
    np.testing.assert_allclose(now, [0.0, -0.006, 0.0], atol=5e-4)
    volume = np.count_nonzero(drawn == -7) * 0.003**3
    tumor = deformation.field.mesh.region == Region.TUMOR
    assert volume == pytest.approx(deformation.field.mesh.volumes[tumor].sum(), rel=0.15)
    with pytest.raises(InputError, match="cavity: the field's mesh has no tumour"):
        draw_cavity(warped.volume, DEFORMATION, DEFORMATION.owner_now(warped.grid), 0.0)


def test_std_is_that_of_the_tissue_which_is_there_now():
    grid = Grid((20, 20, 20), np.array([[0.007, 0, 0, -0.07], [0, 0.007, 0, -0.07], [0, 0, 0.007, -0.07], [0, 0, 0, 1.0]]))
    std = DEFORMATION.std_on(grid)
    now = DEFORMATION.owner_now(grid) >= 0
    np.testing.assert_array_equal(np.isfinite(std), now)
    y = grid.centres(np.argwhere(now))
    x = y + DEFORMATION.inverse_at(y)
    located = DEFORMATION.locator.locate(x, 1e-6)
    np.testing.assert_allclose(std[now], located.interpolate(MESH, FIELD.std), atol=1e-8)

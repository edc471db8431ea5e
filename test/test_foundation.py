"""Units, transforms, files, HDF5 headers and the command line's manners."""

from __future__ import annotations

import subprocess
import sys

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainshift_ros import h5
from brainshift_ros.cli.main import COMMANDS
from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path, existing_file
from brainshift_ros.geometry import invert_rigid, rigid, tangent_frame, transform_points, unit
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.resources import resource
from brainshift_ros.units import affine_m_to_mm, affine_mm_to_m, m_to_mm, mm_to_m

TETRAHEDRON = TetMesh(
    nodes=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    elements=np.array([[0, 1, 2, 3]], dtype=np.int32),
    region=np.array([1], dtype=np.uint8),
    facets={"skull": np.array([[0, 2, 1]], dtype=np.int32)},
    node_sets={"brainstem": np.array([3], dtype=np.int32)},
)

finite = st.floats(-10.0, 10.0)
vectors = st.tuples(finite, finite, finite)


def test_a_millimetre_is_a_thousandth_of_a_metre():
    assert mm_to_m(5.0) == 0.005
    assert m_to_mm([0.25]) == pytest.approx([250.0])
    affine_mm = np.array([[2.0, 0, 0, -90], [0, 2, 0, -126], [0, 0, 2, -72], [0, 0, 0, 1]])
    voxel = np.array([10.0, 20.0, 30.0, 1.0])
    assert 1000.0 * (affine_mm_to_m(affine_mm) @ voxel)[:3] == pytest.approx((affine_mm @ voxel)[:3])
    assert affine_m_to_mm(affine_mm_to_m(affine_mm)) == pytest.approx(affine_mm)


@settings(max_examples=30, deadline=None)
@given(vectors, vectors, vectors)
def test_rigid_inverse_agrees_with_linear_algebra(rotation_vector, translation, point):
    T = rigid(Rotation.from_rotvec(rotation_vector), translation)
    assert invert_rigid(T) == pytest.approx(np.linalg.inv(T), abs=1e-12)
    homogeneous = T @ np.array([*point, 1.0])
    assert transform_points(T, [point])[0] == pytest.approx(homogeneous[:3], abs=1e-12)


@settings(max_examples=30, deadline=None)
@given(vectors.filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_tangent_frame_is_right_handed_and_ends_in_the_normal(normal):
    R = tangent_frame(normal)
    assert pytest.approx(np.eye(3), abs=1e-12) == R @ R.T
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert R[2] == pytest.approx(unit(normal))


def test_a_zero_vector_has_no_direction():
    with pytest.raises(ValueError, match="no direction"):
        unit([0.0, 0.0, 0.0])


def test_volume_of_the_unit_tetrahedron():
    assert TETRAHEDRON.volumes == pytest.approx([1.0 / 6.0])


def test_a_failed_write_leaves_the_earlier_file_and_nothing_else(tmp_path):
    target = tmp_path / "result.nii.gz"
    target.write_text("earlier")

    def write_half_of_it():
        with atomic_path(target) as temporary:
            assert temporary.name.endswith(".nii.gz")
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half_of_it()
    assert [path.name for path in tmp_path.iterdir()] == ["result.nii.gz"]
    assert target.read_text() == "earlier"


def test_writing_into_a_missing_folder_says_so(tmp_path):
    with pytest.raises(InputError, match="its folder does not exist"), atomic_path(tmp_path / "no" / "x.h5"):
        pass


def test_writing_onto_a_folder_says_so(tmp_path):
    with pytest.raises(InputError, match="is a folder"), atomic_path(tmp_path):
        pass


def test_missing_files_and_folders_are_told_apart(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        existing_file(tmp_path / "absent.h5", "patient file")
    with pytest.raises(InputError, match="is a folder"):
        existing_file(tmp_path, "patient file")


def _mesh_file(path, kind="patient", version=1):
    with h5py.File(path, "w") as file:
        h5.write_header(file, kind, version)
        h5.write_mesh(file.create_group("mesh"), TETRAHEDRON)
    return path


def test_a_mesh_comes_back_with_its_names(tmp_path):
    with h5.open_checked(_mesh_file(tmp_path / "a.h5"), "patient", 1) as file:
        mesh = h5.read_mesh(file["mesh"])
    assert np.array_equal(mesh.nodes, TETRAHEDRON.nodes)
    assert np.array_equal(mesh.facets["skull"], TETRAHEDRON.facets["skull"])
    assert np.array_equal(mesh.node_sets["brainstem"], TETRAHEDRON.node_sets["brainstem"])


@pytest.mark.parametrize(
    ("kind", "version", "message"), [("atlas", 1, "is not a brainshift patient file"), ("patient", 9, "has format version 9")]
)
def test_another_kind_or_version_is_refused(tmp_path, kind, version, message):
    with pytest.raises(InputError, match=message):
        h5.open_checked(_mesh_file(tmp_path / "a.h5", kind, version), "patient", 1)


def test_a_file_that_is_not_hdf5_is_refused(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(b"hello")
    with pytest.raises(InputError, match="not a readable HDF5 file"):
        h5.open_checked(path, "patient", 1)


def test_a_moved_node_breaks_the_checksum(tmp_path):
    path = _mesh_file(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        file["mesh/nodes"][0, 0] = 1e-6
    with h5.open_checked(path, "patient", 1) as file, pytest.raises(InputError, match="does not match its checksum"):
        h5.read_mesh(file["mesh"])


def test_shipped_files_are_found():
    assert resource("config/scene_demo.yaml").is_file()
    with pytest.raises(FileNotFoundError, match="not installed"):
        resource("config/absent.yaml")


def _brainshift(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "brainshift_ros.cli.main", *arguments], capture_output=True, text=True, check=False, timeout=60
    )


def test_help_names_every_command():
    shown = _brainshift("--help")
    assert shown.returncode == 0
    assert all(f"\n  {name} " in shown.stdout for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name):
    shown = _brainshift(name, "--help")
    assert shown.returncode == 0, shown.stderr
    assert "Usage: brainshift" in shown.stdout


def test_bad_input_ends_in_one_line_and_status_2(tmp_path):
    shown = _brainshift("sample", str(tmp_path / "absent.h5"), str(tmp_path / "p.csv"), "-o", str(tmp_path / "o.csv"))
    assert shown.returncode == 2
    assert shown.stderr.count("\n") == 1
    assert "absent.h5: no such file" in shown.stderr
    assert "Traceback" not in shown.stderr

"""The small patient: conformity, split septa, named sets, tissue, quality gate, patient file."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skfem import MeshTet

from brainshift_ros.errors import InputError
from brainshift_ros.image.template import template_landmarks
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.patient import PatientModel, Tissue
from brainshift_ros.mesh.patient_file import read_patient, write_patient
from brainshift_ros.mesh.quality import dihedral_angles_deg, refuse_bad_mesh
from brainshift_ros.mesh.split import split_along_septa
from brainshift_ros.mesh.volume import restore_volume
from brainshift_ros.septa.sheets import Septum, septa_from_landmarks, sheet
from brainshift_ros.septa.side import side_of_sheet
from brainshift_ros.surface.facets import face_table, facet_areas
from brainshift_ros.surface.surfacing import merged


def keys(facets: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(f) for f in np.sort(facets, axis=1)}


def normals(nodes: np.ndarray, facets: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(nodes[facets], 1, 0)
    return np.cross(b - a, c - a)


def test_regular_tetrahedron_has_its_angles() -> None:
    nodes = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    angles = dihedral_angles_deg(nodes, np.array([[0, 1, 2, 3]]))
    np.testing.assert_allclose(angles, np.degrees(np.arccos(1 / 3)))


def test_gate_names_each_fault() -> None:
    refuse_bad_mesh({"inverted": 0, "components": 1, "dihedral_min_deg": 12.0, "volume_error_percent": 0.4})
    with pytest.raises(InputError, match=r"inverted is 2.*dihedral_min_deg is 3"):
        refuse_bad_mesh({"inverted": 2, "dihedral_min_deg": 3.0})


def test_size_and_quality(small_patient: PatientModel, template_case: tuple[Volume, Volume]) -> None:
    mesh = small_patient.mesh
    assert 0.8 * 3000 < len(mesh.nodes) < 1.2 * 3000
    assert (mesh.volumes > 0).all()
    assert dihedral_angles_deg(mesh.nodes, mesh.elements).min() >= 10
    _, labels = template_case
    voxel = 8e-9
    assert mesh.volumes.sum() == pytest.approx(voxel * np.count_nonzero(labels.data), rel=0.01)
    tumor = mesh.region == Region.TUMOR
    assert mesh.volumes[tumor].sum() == pytest.approx(voxel * np.count_nonzero(labels.data == Region.TUMOR), rel=0.03)
    np.testing.assert_array_equal(np.unique(mesh.elements), np.arange(len(mesh.nodes)))


def test_tumour_facets_enclose_the_tumour(small_patient: PatientModel) -> None:
    mesh = small_patient.mesh
    a, b, c = np.moveaxis(mesh.nodes[mesh.facets["tumor"]], 1, 0)
    enclosed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6  # divergence theorem
    assert enclosed == pytest.approx(mesh.volumes[mesh.region == Region.TUMOR].sum(), rel=1e-9)


def test_outer_facets_enclose_the_brain(small_patient: PatientModel) -> None:
    mesh = small_patient.mesh
    facets = np.vstack([mesh.facets[name] for name in ("skull", "falx", "tentorium")])
    assert keys(facets) == keys(face_table(mesh.elements).boundary)
    a, b, c = np.moveaxis(mesh.nodes[facets], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(mesh.volumes.sum(), rel=1e-9)


@pytest.mark.parametrize("name", ["falx", "tentorium"])
def test_sheets_have_two_equal_opposite_sides(small_patient: PatientModel, name: str) -> None:
    mesh = small_patient.mesh
    facets = mesh.facets[name]
    one, two = np.split(facets, 2)
    assert not keys(one) & keys(two)
    np.testing.assert_allclose(np.sort(mesh.nodes[one], axis=1), np.sort(mesh.nodes[two], axis=1))
    # each points out of its own element: the left of the falx to the right, the underside of the tentorium up
    axis = {"falx": 0, "tentorium": 2}[name]
    assert (normals(mesh.nodes, one)[:, axis] > 0).mean() > 0.98
    np.testing.assert_allclose(normals(mesh.nodes, one), -normals(mesh.nodes, two), atol=1e-15)
    np.testing.assert_allclose(facet_areas(mesh.nodes, one), facet_areas(mesh.nodes, two))


@pytest.mark.parametrize("name", ["falx", "tentorium"])
def test_sheets_follow_the_landmarks(small_patient: PatientModel, name: str) -> None:
    septa = septa_from_landmarks(template_landmarks().septa, spacing_mm=4.0)
    surface = merged([s.surface for s in septa if s.name == name])
    mesh = small_patient.mesh
    distance = np.abs(side_of_sheet(surface, mesh.nodes[np.unique(mesh.facets[name])]).height)
    assert np.median(distance) < 0.0015
    assert np.percentile(distance, 95) < 0.004
    assert small_patient.quality[f"{name}_area_error_percent"] < 5


def test_split_nodes_coincide_and_rims_are_shared(small_patient: PatientModel) -> None:
    mesh = small_patient.mesh
    pairs = cKDTree(mesh.nodes).query_pairs(1e-9, output_type="ndarray")
    doubled = np.unique(pairs)
    on_sheets = np.unique(np.vstack([mesh.facets["falx"], mesh.facets["tentorium"]]))
    assert len(doubled) > 100
    assert cKDTree(mesh.nodes[on_sheets]).query(mesh.nodes[doubled])[0].max() < 1e-9
    for name in ("falx", "tentorium"):
        rim = mesh.node_sets[f"{name}_rim"]
        assert len(rim) >= 5
        assert set(rim) <= set(np.unique(mesh.facets[name]))
        one, two = (np.unique(side) for side in np.split(mesh.facets[name], 2))
        # nodes that both sides use are those where they are joined
        assert set(rim) <= set(np.intersect1d(one, two))
        assert np.isin(np.intersect1d(one, two), rim).mean() > 0.7
        assert np.isin(rim, doubled).mean() < 0.3


def test_one_component_remains(small_patient: PatientModel) -> None:
    owners = face_table(small_patient.mesh.elements).owners
    count = len(small_patient.mesh.elements)
    graph = coo_array((np.ones(len(owners)), owners.T), shape=(count, count))
    assert connected_components(graph, directed=False)[0] == 1


def test_no_element_face_crosses_the_falx(small_patient: PatientModel) -> None:
    mesh = small_patient.mesh
    table = face_table(mesh.elements)
    pair = mesh.region[table.owners]
    crossing = (pair == [Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM]).all(1)
    crossing |= (pair == [Region.RIGHT_CEREBRUM, Region.LEFT_CEREBRUM]).all(1)
    centre = mesh.nodes[table.interior[crossing]].mean(axis=1)
    # hemispheres still touch through corpus callosum and below, never behind and above it
    assert crossing.any()
    assert not np.any(centre[:, 2] > 0.055)


def test_brainstem_set_and_tissue(small_patient: PatientModel) -> None:
    mesh = small_patient.mesh
    stem = mesh.nodes[mesh.node_sets["brainstem"]]
    np.testing.assert_array_equal(mesh.node_sets["brainstem"], np.unique(mesh.elements[mesh.region == Region.BRAINSTEM]))
    assert np.abs(stem[:, 0]).max() < 0.035
    assert stem[:, 2].max() < 0.02
    assert set(np.unique(small_patient.tissue)) == {Tissue.WHITE, Tissue.GREY, Tissue.TUMOR}
    np.testing.assert_array_equal(small_patient.tissue == Tissue.TUMOR, mesh.region == Region.TUMOR)
    white = small_patient.tissue == Tissue.WHITE
    skull = np.unique(mesh.facets["skull"])
    at_surface = np.isin(mesh.elements, skull).any(axis=1)
    assert white[~at_surface].mean() > white[at_surface].mean()


def test_cortex_lies_on_the_mesh(small_patient: PatientModel) -> None:
    skull = np.unique(small_patient.mesh.facets["skull"])
    distance, _ = cKDTree(small_patient.cortex.vertices).query(small_patient.mesh.nodes[skull])
    assert np.percentile(distance, 90) < 0.006


def test_sheet_through_a_grid_doubles_exactly_its_nodes() -> None:
    grid = MeshTet.init_tensor(*[np.linspace(-0.1, 0.1, 5)] * 3)
    nodes, elements = grid.p.T.copy(), grid.t.T.astype(np.int32)
    x = nodes[elements]
    negative = np.linalg.det(x[:, 1:] - x[:, :1]) < 0
    elements[negative] = elements[negative][:, [1, 0, 2, 3]]
    ring = np.array([[0, -120, 0], [0, 120, 0], [0, 120, 120], [0, -120, 120]], float)  # x = 0, z > 0, in mm
    septum = Septum("falx", sheet(ring, (), (1, 0, 0), spacing_mm=50.0))
    split = split_along_septa(nodes, elements, [septum])
    plane = (nodes[:, 0] == 0) & (nodes[:, 2] > 0)
    assert len(split.nodes) == len(nodes) + np.count_nonzero(plane)
    assert facet_areas(split.nodes, split.facets["falx"]).sum() == pytest.approx(2 * 0.02)
    np.testing.assert_allclose(split.nodes[split.rims["falx"]][:, [0, 2]], 0.0)
    assert len(split.rims["falx"]) == 5
    np.testing.assert_allclose(split.nodes[split.elements], nodes[elements])


def test_volume_is_restored_without_spoiling_elements(small_patient: PatientModel) -> None:
    mesh = small_patient.mesh
    tumor = mesh.region == Region.TUMOR
    wanted = 1.05 * mesh.volumes[tumor].sum()
    nodes = restore_volume(mesh.nodes, mesh.elements, tumor, wanted)
    moved = dataclasses.replace(mesh, nodes=nodes)
    assert moved.volumes[tumor].sum() == pytest.approx(wanted, rel=0.01)
    assert moved.volumes.sum() == pytest.approx(mesh.volumes.sum(), rel=1e-3)
    assert dihedral_angles_deg(nodes, mesh.elements).min() > 0.85 * dihedral_angles_deg(mesh.nodes, mesh.elements).min()


@pytest.mark.parametrize("nodes", [10, 1_000_000])
def test_impossible_sizes_are_refused(template_case: tuple[Volume, Volume], small_patient: PatientModel, nodes: int) -> None:
    with pytest.raises(InputError, match="nodes"):
        build_patient(*template_case, image_ref=small_patient.image, nodes=nodes)


def test_file_round_trip(small_patient: PatientModel, tmp_path: Path) -> None:
    write_patient(tmp_path / "p.h5", small_patient)
    again = read_patient(tmp_path / "p.h5")
    assert again.patient_id == small_patient.patient_id
    assert dict(again.quality) == pytest.approx(dict(small_patient.quality))
    assert again.warnings == small_patient.warnings
    assert again.image.shape == small_patient.image.shape
    np.testing.assert_array_equal(again.mesh.nodes, small_patient.mesh.nodes)
    np.testing.assert_array_equal(again.cortex.faces, small_patient.cortex.faces)
    for name, facets in small_patient.mesh.facets.items():
        np.testing.assert_array_equal(again.mesh.facets[name], facets)


def test_a_model_without_quality_figures_and_warnings_round_trips(small_patient: PatientModel, tmp_path: Path) -> None:
    write_patient(tmp_path / "p.h5", dataclasses.replace(small_patient, quality={}, warnings=()))
    again = read_patient(tmp_path / "p.h5")
    assert (dict(again.quality), again.warnings, again.patient_id) == ({}, (), small_patient.patient_id)


@pytest.mark.parametrize("dataset", ["mesh/nodes", "tissue", "cortex/vertices", "image/T_patient_voxel"])
def test_tampering_is_noticed(small_patient: PatientModel, tmp_path: Path, dataset: str) -> None:
    path = tmp_path / "p.h5"
    write_patient(path, small_patient)
    with h5py.File(path, "r+") as file:
        values = file[dataset][()]
        values[0] += 1
        file[dataset][...] = values
    with pytest.raises(InputError, match="does not match"):
        read_patient(path)


def test_broken_files_are_refused(small_patient: PatientModel, tmp_path: Path) -> None:
    path = tmp_path / "p.h5"
    write_patient(path, small_patient)
    whole = path.read_bytes()
    for size in (0, 100, len(whole) // 2, len(whole) - 1000):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"cut off|not a"):
            read_patient(path)
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        del file["cortex/faces"]
    with pytest.raises(InputError, match="lacks parts"):
        read_patient(path)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "brainshift/atlas"
    with pytest.raises(InputError, match="not a brainshift patient"):
        read_patient(path)

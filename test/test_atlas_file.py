"""The atlas file: what was written is read, and nothing else."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from importlib.resources import files
from pathlib import Path

import h5py
import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import head, patient

from brainshift_ros.atlas.columns import entries_of, groups_of
from brainshift_ros.atlas.contiguous import read_columns
from brainshift_ros.atlas.diagnostics import DIAGNOSTICS
from brainshift_ros.atlas.file import BLOCK_NODES, AtlasContent, open_atlas, write_atlas
from brainshift_ros.atlas.scene import Gravity, Mannitol, Scene, Swelling
from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.materials import TABLE_1

SCENE = Scene(
    gravity=Gravity(direction=(0.0, 0.0, -1.0), orientations=7, fluid_levels=2),
    mannitol=Mannitol(permeability_levels=2),
    swelling=Swelling(pressure_levels=1),
    resection="both",
)
ENTRIES = entries_of(SCENE)
PATIENT = patient(head(10))  # more nodes than one block of checksums
DIAGNOSED = np.zeros(len(ENTRIES), dtype=DIAGNOSTICS)
DIAGNOSED["smallest_det_f"] = np.linspace(-0.1, 0.9, len(ENTRIES))
DIAGNOSED["inverted_elements"] = DIAGNOSED["smallest_det_f"] < 0.0
CONTENT = AtlasContent(
    *(PATIENT.patient_id, PATIENT.mesh, PATIENT.tissue, SCENE, ENTRIES, groups_of(ENTRIES)),
    diagnostics=DIAGNOSED,
    solver="pardiso",
)
E = np.random.default_rng(0).normal(size=(len(PATIENT.mesh.nodes), 3, len(ENTRIES))).astype(np.float32)


@pytest.fixture(scope="module")
def atlas_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("atlas") / "atlas.h5"
    write_atlas(path, CONTENT, E)
    return path


@pytest.fixture(scope="module")
def atlas(atlas_path):
    with open_atlas(atlas_path) as opened:
        yield opened


@pytest.fixture
def copy(atlas_path, tmp_path):
    return shutil.copy(atlas_path, tmp_path / "copy.h5")


def test_everything_comes_back(atlas):
    assert len(PATIENT.mesh.nodes) > BLOCK_NODES
    assert atlas.entries == ENTRIES
    assert dict(atlas.materials) == dict(TABLE_1)
    assert atlas.solver == "pardiso"
    np.testing.assert_array_equal(atlas.diagnostics, DIAGNOSED)
    assert atlas.groups == CONTENT.groups
    assert atlas.scene == SCENE
    assert atlas.patient_id == PATIENT.patient_id
    np.testing.assert_array_equal(atlas.mesh.nodes, PATIENT.mesh.nodes)
    np.testing.assert_array_equal(atlas.mesh.elements, PATIENT.mesh.elements)
    np.testing.assert_array_equal(atlas.tissue, PATIENT.tissue)
    assert set(atlas.mesh.facets) == set(PATIENT.mesh.facets)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, E.shape[0] - 1), max_size=60), st.lists(st.integers(0, E.shape[2] - 1), max_size=20))
def test_rows_and_columns_are_those_of_the_matrix(atlas, nodes, columns):
    np.testing.assert_array_equal(atlas.rows(nodes), E[np.array(nodes, int)])
    np.testing.assert_array_equal(atlas.columns(columns), E[:, :, np.array(columns, int)])
    assert atlas.rows(nodes).dtype == np.float32


@pytest.mark.parametrize("bad", [[-1], [10**6], [0.5], [[0, 1]]])
def test_ids_outside_the_matrix_are_refused(atlas, bad):
    with pytest.raises(IndexError):
        atlas.rows(bad)
    with pytest.raises(IndexError):
        atlas.columns(bad)


def test_info_satisfies_its_published_schema(atlas, atlas_path):
    schema = json.loads((files("brainshift_ros.atlas") / "info.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    info = json.loads(json.dumps(atlas.info()))
    jsonschema.validate(info, schema)
    assert info["entries"] == 70
    assert info["mechanisms"] == ["gravity", "mannitol", "swelling"]
    assert info["path"] == str(atlas_path)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**info, "atlas_id": "none"}, schema)


def test_table_says_what_the_levels_stand_for(atlas_path):
    # Table 1: k_c from 11.5e-9 to 34.5e-9 1/(Pa s) in grey matter, p_c -3633 Pa.
    with h5py.File(atlas_path) as file:
        table = file["entries"][()]
    kinds = [
        (b"gravity", 0.0, 11.5e-9, 2.3e-9),
        (b"mannitol", -3633.0, 11.5e-9, 2.3e-9),
        (b"mannitol", -3633.0, 34.5e-9, 6.9e-9),
        (b"swelling", 3633.0, 11.5e-9, 2.3e-9),
    ]
    found = {
        (row["mechanism"], row["capillary_pressure"], round(row["exchange_grey"], 12), round(row["exchange_white"], 12))
        for row in table
    }
    assert found == set(kinds)


def test_id_depends_on_content_alone(tmp_path, atlas):
    path = tmp_path / "again.h5"
    assert write_atlas(path, CONTENT, E) == atlas.atlas_id
    assert write_atlas(path, dataclasses.replace(CONTENT, diagnostics=None, solver="scipy"), E) == atlas.atlas_id
    with open_atlas(path) as undiagnosed:
        assert undiagnosed.diagnostics is None
    changed = E.copy()
    changed[3, 1, 9] += 1e-3
    ids = {
        atlas.atlas_id,
        write_atlas(path, CONTENT, changed),
        write_atlas(path, dataclasses.replace(CONTENT, patient_id="cd" * 32), E),
        write_atlas(path, dataclasses.replace(CONTENT, scene=SCENE.model_copy(update={"septa": False})), E),
        write_atlas(path, dataclasses.replace(CONTENT, entries=ENTRIES[::-1]), E),
    }
    assert len(ids) == 5


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        open_atlas(tmp_path / "absent.h5")
    text = tmp_path / "text.h5"
    text.write_text("not an atlas")
    with pytest.raises(InputError, match="not a readable HDF5"):
        open_atlas(text)
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["E"] = E
    with pytest.raises(InputError, match="not a brainshift atlas file"):
        open_atlas(foreign)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.99])
def test_cut_off_files_are_refused(copy, share):
    whole = Path(copy).read_bytes()
    Path(copy).write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match="cut off"):
        open_atlas(copy)


def test_a_file_cut_short_while_it_is_open_is_an_error(copy):
    with open_atlas(copy) as atlas:
        os.truncate(copy, os.path.getsize(copy) // 2)
        with pytest.raises(InputError, match="cannot be read"):
            atlas.columns([0, 1])


@pytest.mark.parametrize("stored", [{}, {"chunks": (64, 3, 8)}, {"dtype": ">f4"}])
def test_columns_are_those_of_hdf5_however_they_are_stored(tmp_path, stored):
    ids = np.array([5, 2, 5, E.shape[2] - 1])
    with h5py.File(tmp_path / "matrix.h5", "w") as file:
        matrix = file.create_dataset("E", data=E, **stored)
        file.flush()
        np.testing.assert_array_equal(read_columns(matrix, ids), matrix[()][:, :, ids])


def damage(name):
    def apply(file):
        if name == "version":
            file.attrs["version"] = 99
        elif name == "one value":
            file["E"][1030, 2, 65] += np.float32(1e-4)
        elif name == "nodes":
            file["mesh/nodes"][0, 0] += 1e-6
        elif name == "tissue":
            file["tissue"][0] += 1
        elif name == "scene":
            file.attrs["scene"] = SCENE.model_copy(update={"septa": False}).model_dump_json()
        elif name == "broken scene":
            file.attrs["scene"] = "{"
        elif name == "groups":
            file.attrs["groups"] = json.dumps([{"name": "a", "columns": [70], "sum_limit": 1.0}])
        elif name == "broken groups":
            file.attrs["groups"] = json.dumps([{"name": "a"}])
        elif name == "entries":
            table = file["entries"][()]
            table["fluid_level"][0] = 0.9
            file["entries"][...] = table
        elif name == "fewer entries":
            table = file["entries"][:-1]
            del file["entries"]
            file["entries"] = table
        elif name == "no matrix":
            del file["E"]
        elif name == "no checksums":
            del file["E_sha256"]
            file["E_sha256"] = np.zeros(0, "S64")
        elif name == "diagnostics":
            table = file["diagnostics"][()]
            table["residual"][3] = 1e-16
            file["diagnostics"][...] = table
        elif name == "older version":
            file.attrs["version"] = 1
        elif name == "no id":
            del file.attrs["atlas_id"]

    return apply


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("version", "format version 99"),
        ("one value", "rows of nodes 1024 to .* do not match their checksum"),
        ("nodes", "mesh does not match its checksum"),
        ("tissue", "does not match its id"),
        ("scene", "does not match its id"),
        ("broken scene", "cannot be read"),
        ("groups", "weight group"),
        ("broken groups", "cannot be read"),
        ("entries", "does not match its id"),
        ("fewer entries", "mesh and entries need"),
        ("no matrix", "cannot be read"),
        ("no checksums", "checksums of its matrix are missing"),
        ("diagnostics", "diagnostics do not match their checksum"),
        ("older version", "format version 1, this software reads 2; make the atlas file again"),
        ("no id", "cannot be read"),
    ],
)
def test_changed_files_are_refused(copy, fault, words):
    with h5py.File(copy, "r+") as file:
        damage(fault)(file)
    with pytest.raises(InputError, match=words) as caught:
        open_atlas(copy)
    assert caught.value.source == str(copy)
    with h5py.File(copy, "r+"):  # the refused file was closed again
        pass


def test_matrix_that_does_not_fit_is_not_written(tmp_path):
    path = tmp_path / "atlas.h5"
    for wrong in (E[:-1], E.astype(np.float64), np.where(E[0, 0, 0] == E, np.float32(np.nan), E)):
        with pytest.raises(ValueError):
            write_atlas(path, CONTENT, wrong)
    with pytest.raises(ValueError, match="diagnostics"):
        write_atlas(path, dataclasses.replace(CONTENT, diagnostics=DIAGNOSED[:-1]), E)
    assert list(tmp_path.iterdir()) == []


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "atlas.h5"
    write_atlas(path, CONTENT, E)
    before = path.read_bytes()

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr("brainshift_ros.atlas.file._atlas_id", full)
    with pytest.raises(OSError, match="no space"):
        write_atlas(path, CONTENT, E)
    assert [p.name for p in tmp_path.iterdir()] == ["atlas.h5"]
    assert path.read_bytes() == before

"""The field file: round trip, and one clear error for each fault."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
from field_cases import box_mesh

from brainshift_ros.errors import InputError
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.field_file import read_field, write_field


def field():
    mesh = box_mesh((2, 2, 2), (0, 0, 0), (0.02, 0.02, 0.02))
    mesh = replace(mesh, facets={"skull": mesh.elements[:3, :3]}, node_sets={"brainstem": np.arange(4, dtype=np.int32)})
    rng = np.random.default_rng(0)
    provenance = {"patient_id": "p1", "valid": True, "weights": {"3": 0.5}, "note": "Größe"}
    return DisplacementField(mesh, rng.normal(size=(27, 3)), rng.uniform(size=27), provenance)


def test_round_trip(tmp_path):
    original = field()
    write_field(tmp_path / "field.h5", original)
    again = read_field(tmp_path / "field.h5")
    np.testing.assert_array_equal(again.displacement, original.displacement)
    np.testing.assert_array_equal(again.std, original.std)
    np.testing.assert_array_equal(again.mesh.elements, original.mesh.elements)
    np.testing.assert_array_equal(again.mesh.facets["skull"], original.mesh.facets["skull"])
    assert again.provenance == original.provenance
    assert [p.name for p in tmp_path.iterdir()] == ["field.h5"]


def damage(path, change):
    with h5py.File(path, "r+") as file:
        change(file)


def set_value(name, index, value):
    def change(file):
        file[name][index] = value

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda f: f.attrs.__setitem__("format", "brainshift/atlas"), "is not a brainshift field file"),
        (lambda f: f.attrs.__setitem__("version", 9), "format version 9"),
        (lambda f: f.__delitem__("mesh"), "has no mesh"),
        (lambda f: f.__delitem__("mesh/nodes"), "mesh cannot be read"),
        (lambda f: f.__delitem__("std"), "displacement cannot be read"),
        (lambda f: f.attrs.__delitem__("provenance"), "displacement cannot be read"),
        (lambda f: f.attrs.__setitem__("provenance", "{"), "displacement cannot be read"),
        (set_value("displacement", 3, 0.0), "does not match its checksum"),
        (set_value("mesh/nodes", 3, 0.5), "mesh does not match its checksum"),
        (lambda f: f.attrs.__setitem__("provenance", "{}"), "does not match its checksum"),
    ],
)
def test_each_fault_is_one_clear_error(tmp_path, change, match):
    path = tmp_path / "field.h5"
    write_field(path, field())
    damage(path, change)
    with pytest.raises(InputError, match=match) as caught:
        read_field(path)
    assert "field.h5" in str(caught.value)


def test_values_that_are_not_finite_and_wrong_shapes_are_refused(tmp_path):
    good = field()
    write_field(tmp_path / "nan.h5", replace(good, std=np.full(27, np.nan)))
    with pytest.raises(InputError, match="not finite"):
        read_field(tmp_path / "nan.h5")
    write_field(tmp_path / "short.h5", replace(good, std=good.std[:5]))
    with pytest.raises(InputError, match="for 27 nodes"):
        read_field(tmp_path / "short.h5")


def test_cut_off_foreign_and_missing_files(tmp_path):
    path = tmp_path / "field.h5"
    write_field(path, field())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cut off"):
        read_field(path)
    path.write_text("x y z\n")
    with pytest.raises(InputError, match="not a readable HDF5"):
        read_field(path)
    with pytest.raises(InputError, match="no such file"):
        read_field(tmp_path / "none.h5")
    with pytest.raises(InputError, match="folder does not exist"):
        write_field(tmp_path / "no" / "field.h5", field())

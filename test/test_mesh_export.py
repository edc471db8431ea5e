"""The exported mesh, read back by meshio."""

from __future__ import annotations

import meshio
import numpy as np
import pytest

from brainshift_ros.errors import InputError
from brainshift_ros.mesh.export import export_mesh


def test_other_software_gets_the_same_tetrahedra(small_patient, tmp_path):
    export_mesh(tmp_path / "mesh.vtu", small_patient)
    read = meshio.read(tmp_path / "mesh.vtu")
    assert np.array_equal(read.points, small_patient.mesh.nodes)
    assert np.array_equal(read.cells_dict["tetra"], small_patient.mesh.elements)
    assert np.array_equal(read.cell_data["region"][0], small_patient.mesh.region)


def test_an_unknown_suffix_is_named(small_patient, tmp_path):
    with pytest.raises(InputError, match=r"mesh\.docx: meshio cannot write it"):
        export_mesh(tmp_path / "mesh.docx", small_patient)
    assert not list(tmp_path.iterdir())

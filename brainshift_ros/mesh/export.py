"""Meshes for other software (ParaView, Slicer, FEBio), by meshio."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path
from brainshift_ros.mesh.patient import PatientModel


def export_mesh(path: str | Path, patient: PatientModel) -> None:
    """Write the tetrahedra with region and tissue of each element, in metres of the patient frame.

    Parameters
    ----------
    path
        The suffix chooses the format: ``.vtu``, ``.vtk``, ``.msh``, ``.xdmf`` or any other that meshio writes.

    Raises
    ------
    InputError
        meshio knows no such format.
    """
    path = Path(path)
    mesh = patient.mesh
    data = {"region": [mesh.region.astype(np.int32)], "tissue": [patient.tissue.astype(np.int32)]}
    exported = meshio.Mesh(mesh.nodes, [("tetra", mesh.elements)], cell_data=data)
    with atomic_path(path) as temporary:
        try:
            meshio.write(temporary, exported)
        except (meshio.WriteError, meshio.ReadError) as error:
            raise InputError(
                path, f"meshio cannot write it ({type(error).__name__})", "choose a suffix such as .vtu or .msh"
            ) from error

"""Which elements are solved: all, or those that resection leaves; septa split or joined."""

from __future__ import annotations

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.faces import ElementFaces
from brainshift_ros.mechanics.submesh import Submesh, compose, join_septa, remove_elements, unsupported_elements, whole
from brainshift_ros.mesh.tetmesh import TetMesh


def solved_elements(mesh: TetMesh, *, resected: bool, septa: bool) -> tuple[Submesh, tuple[str, ...]]:
    """Derive the mesh that is solved from the patient's.

    Parameters
    ----------
    mesh
        The patient's mesh.
    resected
        Remove the tumour's elements, and what hung on them alone.
    septa
        Keep falx and tentorium split.

    Returns
    -------
    The derived mesh, and what was done beyond what was asked.

    Raises
    ------
    InputError
        The brain hangs on nothing, is not one piece, or there is no tumour to resect.
    """
    base = whole(mesh) if septa else join_septa(mesh)
    faces = ElementFaces(base.mesh.elements)
    removed = np.zeros(len(mesh.elements), dtype=bool)
    loose = unsupported_elements(base.mesh, removed, faces)
    if loose.any():
        problem = f"{int(loose.sum())} elements share no face with the part that the brainstem holds"
        raise InputError("mesh", problem, "make the mesh again as one piece")
    warnings: tuple[str, ...] = ()
    if resected:
        removed = base.mesh.region == Region.TUMOR
        if not removed.any():
            raise InputError("mesh", "it has no tumour to resect", "give a tumour, or set `resection: none` in the scene")
        loose = unsupported_elements(base.mesh, removed, faces)
        if loose.any():
            warnings = (f"{int(loose.sum())} elements lost their hold with the tumour and were removed with it",)
        removed = removed | loose
    return compose(base, remove_elements(base.mesh, removed, faces)), warnings

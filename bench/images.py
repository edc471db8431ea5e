"""Warping an image: time of the whole and its parts, beside SimpleITK's and SciPy's resamplers; errors of the sampled map."""

from __future__ import annotations

from typing import Any

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from scipy import ndimage

from bench.measure import Timed, timed
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.field.checks import Errors, check_map
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.warp import resample_through, warp_image
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.volume import Volume
from brainshift_ros.mechanics.forward import solve_gravity
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.units import m_to_mm

SIZE, EDGE_M, RUNS = 256, 1e-3, 2

#: Voxel edges, metres, at which the transform file's error is measured.
EDGES_M = (0.5e-3, 1e-3, 2e-3)


def run(patient: PatientModel, scene: Scene) -> dict[str, list[dict[str, Any]]]:
    """Bring a 256^3 image to where gravity leaves the brain; both tables by what they measure."""
    assert scene.gravity is not None
    solution = solve_gravity(patient.mesh, material_of(patient.tissue), scene.gravity.direction, 0.2)
    nodes = len(patient.mesh.nodes)
    field = DisplacementField(patient.mesh, solution.displacement, np.zeros(nodes), {"patient_id": patient.patient_id})
    return {"warp": times(field), "transform": sampling_errors(field)}


def times(field: DisplacementField) -> list[dict[str, Any]]:
    """Time the parts of :func:`warp_image`, and other resamplers on the same map and image."""
    image = _image(field)
    grid = Grid.of(image)
    ready = Deformation(field)
    inverse = ready.inverse_on(grid)
    labels = Volume(ready.inside(grid).astype(np.uint8), image.T_patient_voxel)
    ours = resample_through(image, inverse, grid).data
    rows = [
        _row("warp_image: all of it", timed(lambda: warp_image(Deformation(field), image), RUNS)),
        _row("- field around the brain", timed(lambda: Deformation(field).surroundings, RUNS)),
        _row("- inverse on the grid", timed(lambda: ready.inverse_on(grid), RUNS)),
        _row("- resampling", timed(lambda: resample_through(image, inverse, grid), RUNS)),
        _row("labels, smooth edges", timed(lambda: resample_through(labels, inverse, grid, "labels"), RUNS)),
    ]
    for name, peer in (("resampling by SimpleITK's transform", _by_transform), ("resampling by scipy", _by_scipy)):
        solved = timed(lambda peer=peer: peer(image, inverse), RUNS)
        inner = (slice(16, -16),) * 3
        apart = float(np.abs(solved.result[inner].astype(float) - ours[inner]).max())
        rows.append(_row(name, solved) | {"largest difference from ours, grey levels": apart})
    return rows


def sampling_errors(field: DisplacementField) -> list[dict[str, Any]]:
    """How far the transform file's trilinear map is from the mesh's exact one, by voxel edge."""
    deformation, rows = Deformation(field), []
    now = deformation.deformed_nodes
    for edge in EDGES_M:
        grid = Grid.around(now, edge, 0.005)
        checks = check_map(deformation, deformation.inverse_on(grid), grid, deformation.owner_now(grid))
        rows.append(
            {
                "voxel, mm": float(m_to_mm(edge)),
                **_errors("brain", checks.sampling_brain),
                **_errors("within a voxel of septa and surface", checks.sampling_sheets),
                "smallest Jacobian, mesh": checks.jacobian_brain,
                "smallest Jacobian, around": checks.jacobian_around,
                "cells": int(np.prod(np.array(grid.shape) - 1)),
                "cells that fold": checks.folded_cells,
                "of them at septa and surface": checks.folded_cells_at_sheets,
                "of them outside the brain": checks.folded_cells_around,
            }
        )
    return rows


def _image(field: DisplacementField) -> Volume:
    """Smooth grey values, nowhere zero, centred on the brain: no part of the grid can be skipped."""
    noise = ndimage.zoom(np.random.default_rng(0).normal(size=(32, 32, 32)), SIZE / 32, order=1)
    T = np.diag([EDGE_M, EDGE_M, EDGE_M, 1.0])
    T[:3, 3] = field.mesh.nodes.mean(axis=0) - EDGE_M * (SIZE - 1) / 2.0
    return Volume((500.0 + 100.0 * noise).astype(np.int16), T)


def _by_transform(image: Volume, inverse: NDArray[np.float32]) -> NDArray:
    """ITK's axes are the array's in reverse order; the image lies along the patient's axes."""
    in_voxels = np.ascontiguousarray(inverse[..., ::-1] / EDGE_M, dtype=np.float64)
    transform = sitk.DisplacementFieldTransform(sitk.GetImageFromArray(in_voxels, isVector=True))
    moving = sitk.GetImageFromArray(image.data.astype(np.float32))
    return np.rint(sitk.GetArrayFromImage(sitk.Resample(moving, moving, transform, sitk.sitkLinear, 0.0))).astype(np.int16)


def _by_scipy(image: Volume, inverse: NDArray[np.float32]) -> NDArray:
    voxels = np.indices(image.shape, dtype=np.float32)
    voxels += np.moveaxis(inverse, -1, 0) / np.float32(EDGE_M)
    return ndimage.map_coordinates(image.data, voxels, order=1, mode="grid-constant")


def _row(name: str, solved: Timed) -> dict[str, Any]:
    return {"what": name, "wall, s": solved.wall_s, "CPU, s": solved.cpu_s, "largest difference from ours, grey levels": ""}


def _errors(where: str, errors: Errors) -> dict[str, float]:
    named = {"mean": errors.mean, "95 %": errors.p95, "largest": errors.largest}
    return {f"error {where}, {name}, mm": float(m_to_mm(value)) for name, value in named.items()}

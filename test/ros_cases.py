"""A small case with a known answer: a box of tissue, an atlas of smooth fields, points measured on one combination of them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from nilearn.datasets import load_mni152_brain_mask
from scipy import ndimage
from scipy.spatial.transform import Rotation
from simulation_cases import mni_cortex
from skfem import MeshTet

from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
from brainshift_ros.atlas.file import AtlasContent, write_atlas
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.geometry import rigid, transform_points, unit
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.patient_file import patient_digest
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.simulation.scanner import Scanner, scanner_pose, take_scan
from brainshift_ros.simulation.scene import make_scene
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import affine_mm_to_m

SIZE_M = 0.14
TRUE_WEIGHTS = np.array([0.5, 0.0, 0.3, 0.0, 0.0, 0.1])


def with_outer_facets(nodes, elements):
    """Mesh of these elements, turned to positive volume, with its outer facets oriented outward and its lowest nodes fixed."""
    elements = np.ascontiguousarray(elements, dtype=np.int32)
    negative = np.linalg.det(nodes[elements][:, 1:] - nodes[elements][:, :1]) < 0
    elements[negative] = elements[negative][:, [0, 2, 1, 3]]
    sides = elements[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    skull = sides[first[count == 1]]
    lowest = np.flatnonzero(nodes[:, 2] < nodes[:, 2].min() + 1e-3).astype(np.int32)
    return TetMesh(nodes, elements, np.ones(len(elements), dtype=np.uint8), {"skull": skull}, {"brainstem": lowest})


def box_mesh(per_edge=7):
    """Tetrahedra in a cube around the origin."""
    grid = np.linspace(-SIZE_M / 2, SIZE_M / 2, per_edge)
    mesh = MeshTet.init_tensor(grid, grid, grid)
    return with_outer_facets(np.ascontiguousarray(mesh.p.T), mesh.t.T)


def box_directions():
    return unit(np.array([[0, -1, 0], [0.3, -1, 0], [-0.3, -1, 0], [0, -1, 0.3], [0, -1, -0.3], [0.2, -1, 0.2]], dtype=float))


def box_columns(mesh, scale=1.0):
    """Displacements (N, 3, m): along each direction, up to 12 mm at the top, turning slightly with height."""
    height = (mesh.nodes[:, 2] + SIZE_M / 2) / SIZE_M
    directions = box_directions()
    amount = 0.012 * scale * height[:, None] * (1.0 + 0.3 * np.sin(9.0 * mesh.nodes[:, :1] + np.arange(len(directions))))
    return (directions.T[None] * amount[:, None, :]).astype(np.float32)


def write_columns(path, mesh, columns, patient_id):
    """Write an atlas of given columns; return its id."""
    entries = tuple(AtlasEntry("gravity", tuple(map(float, d)), 0.5, 0, False) for d in box_directions())
    content = AtlasContent(
        patient_id=patient_id,
        mesh=mesh,
        tissue=np.ones(len(mesh.elements), dtype=np.uint8),
        scene=Scene.model_validate({"gravity": {"direction": [0.0, -1.0, 0.0], "orientations": len(entries)}}),
        entries=entries,
        groups=(WeightGroup("gravity", tuple(range(len(entries)))),),
    )
    return write_atlas(path, content, columns)


def write_box_atlas(path, scale=1.0, patient_id="b0" * 32):
    """Write the box's atlas; return its id."""
    mesh = box_mesh()
    return write_columns(path, mesh, box_columns(mesh, scale), patient_id)


def box_truth():
    """Displacement at the nodes, shape (N, 3), metres: a combination that the atlas holds exactly."""
    return box_columns(box_mesh()).astype(np.float64) @ TRUE_WEIGHTS


def measured_points():
    """Points on the top of the box, displaced as the truth is."""
    mesh = box_mesh()
    top = np.flatnonzero(mesh.nodes[:, 2] > SIZE_M / 2 - 1e-6)
    return HomologousPoints(mesh.nodes[top], box_truth()[top], np.full(len(top), 2e-4))


# A case on a real cortex: MNI152's, with a coarse tetrahedral grid of its brain and smooth columns in closed form.

CRANIOTOMY_M = np.array([-0.035, 0.045, 0.050])
OPENING_M = 0.070
UP = unit(np.array([-0.45, 0.55, 0.70]))
BRAIN_WEIGHTS = np.array([0.4, 0.0, 0.25, 0.0, 0.0, 0.15])


def brain_fields(points):
    """Columns of the brain's atlas in closed form: points (..., 3) -> (..., 3, m), metres."""
    directions = unit(-UP + 0.25 * box_directions())
    height = np.clip((points @ UP + 0.05) / 0.15, 0.0, None)
    ripple = 1.0 + 0.2 * np.sin(30.0 * points[..., :1] + np.arange(len(directions)))
    return directions.T * (0.012 * height[..., None] ** 2 * ripple)[..., None, :]


def brain_shift(points):
    """True displacement at points (n, 3), metres: a combination that the atlas holds."""
    return brain_fields(points) @ BRAIN_WEIGHTS


@lru_cache
def brain_patient():
    """Patient with MNI152's cortex and a mesh of 9 mm cells over its brain."""
    mask_image = load_mni152_brain_mask(resolution=1)
    mask = ndimage.binary_dilation(np.asarray(mask_image.dataobj) > 0, iterations=4)
    low, high = np.array([-0.08, -0.12, -0.08]), np.array([0.08, 0.09, 0.09])
    grid = MeshTet.init_tensor(*(np.arange(low[axis], high[axis], 0.009) for axis in range(3)))
    nodes, elements = grid.p.T, grid.t.T
    voxels = (
        transform_points(np.linalg.inv(affine_mm_to_m(mask_image.affine)), nodes[elements].mean(axis=1)).round().astype(int)
    )
    inside = np.all((voxels >= 0) & (voxels < mask.shape), axis=1)
    inside[inside] = mask[tuple(voxels[inside].T)]
    used, elements = np.unique(elements[inside], return_inverse=True)
    mesh = with_outer_facets(np.ascontiguousarray(nodes[used]), elements.reshape(-1, 4))
    image = ImageReference("MNI152", "0" * 64, mask.shape, affine_mm_to_m(mask_image.affine))
    tissue = np.ones(len(mesh.elements), dtype=np.uint8)
    cortex = near_opening(mni_cortex())
    return PatientModel(mesh, tissue, cortex, image, {"inverted": 0.0}, (), patient_digest(mesh, tissue, cortex, image))


def near_opening(surface, radius=0.065):
    """Keep the faces around the craniotomy: what registration needs, at a fraction of its time."""
    near = np.linalg.norm(surface.vertices - CRANIOTOMY_M, axis=1) < radius
    used, faces = np.unique(surface.faces[near[surface.faces].all(axis=1)], return_inverse=True)
    return Surface(surface.vertices[used], faces.reshape(-1, 3).astype(np.int32))


def write_brain_atlas(path, patient):
    """Write the brain's atlas; return its id."""
    return write_columns(path, patient.mesh, brain_fields(patient.mesh.nodes).astype(np.float32), patient.patient_id)


@lru_cache
def brain_scans(shift=brain_shift, scanner=None, seed=3):
    """First and later scan, the true T_patient_tracker, and an initial pose that is 4 degrees and 5 mm off."""
    scene = make_scene(mni_cortex(threshold=0.45), CRANIOTOMY_M, OPENING_M, seed)
    T_patient_tracker = rigid(Rotation.from_euler("xyz", [20, -35, 60], degrees=True), [0.3, -0.5, 0.9])
    scanner = scanner or Scanner()
    T_patient_scanner = scanner_pose(scene.craniotomy, scanner, 8.0, 40.0, 15.0)
    first = take_scan(scene, T_patient_tracker, T_patient_scanner, seed=seed, scanner=scanner, stamp_ns=10_000_000_000)
    later = take_scan(
        scene, T_patient_tracker, T_patient_scanner, seed=seed + 1, displacement=shift, scanner=scanner, stamp_ns=10_200_000_000
    )
    turn = rigid(Rotation.from_rotvec(np.deg2rad([2.0, -3.0, 2.0])), [0.0, 0.0, 0.0])
    about = np.eye(4)
    about[:3, 3] = CRANIOTOMY_M
    off = about @ turn @ np.linalg.inv(about)
    off[:3, 3] += [0.003, -0.003, 0.002]
    return first.scan, later.scan, T_patient_tracker, off @ T_patient_tracker

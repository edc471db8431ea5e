"""Surfaces from masks: marching cubes, smoothing with and without shrinkage, decimation (spec P3)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points, unit
from brainshift_ros.surface.facets import facet_areas
from brainshift_ros.surface.surface import Surface


def surface_of_mask(mask: NDArray[np.bool_], T_patient_voxel: NDArray[np.float64], blur: float = 0.0) -> Surface:
    """Close triangle surface around a mask, by marching cubes at one half (Lewiner et al. 2003).

    Parameters
    ----------
    mask
        Shape (I, J, K); may touch the border of the grid.
    T_patient_voxel
        4x4, metres.
    blur
        Standard deviation, metres, of a Gaussian over the mask beforehand; it takes the stair steps away.

    Raises
    ------
    InputError
        The mask is empty.
    """
    if not mask.any():
        raise InputError("mask", "is empty, so it has no surface", "give a mask with voxels in it")
    blur_voxels = blur / np.linalg.norm(T_patient_voxel[:3, :3], axis=0)  # voxels of a slab scan are longer across slices
    pad = 2 + round(3 * float(blur_voxels.max()))
    field = np.pad(mask.astype(np.float32), pad)
    if blur > 0.0:
        field = ndimage.gaussian_filter(field, blur_voxels)
    return isosurface(field, 0.5, T_patient_voxel, pad)


def isosurface(field: NDArray[np.float32], level: float, T_patient_voxel: NDArray[np.float64], pad: int = 0) -> Surface:
    """Triangles where `field` equals `level`, normals pointing to lower values; `pad` voxels were added on each side."""
    vertices, faces, _, _ = marching_cubes(field, level, gradient_direction="ascent")
    if np.linalg.det(T_patient_voxel[:3, :3]) < 0.0:
        faces = faces[:, ::-1]  # a mirrored grid turns normals inward
    return Surface(transform_points(T_patient_voxel, vertices - pad), np.ascontiguousarray(faces, dtype=np.int32))


def smooth_taubin(surface: Surface, iterations: int = 30, pass_band: float = 0.05) -> Surface:
    """Smooth with a windowed-sinc low-pass filter, which keeps the volume (Taubin, Zhang, Golub 1996)."""
    return _surface(polydata(surface).smooth_taubin(n_iter=iterations, pass_band=pass_band))


def smooth_laplacian(surface: Surface, iterations: int = 30, relaxation: float = 0.2) -> Surface:
    """Smooth by moving vertices to the mean of their neighbours, as the thesis does; it shrinks."""
    return _surface(polydata(surface).smooth(n_iter=iterations, relaxation_factor=relaxation))


def decimate(surface: Surface, faces: int) -> Surface:
    """Reduce to about `faces` triangles by quadric error (Garland and Heckbert 1997); smaller surfaces stay as they are."""
    if len(surface.faces) <= faces:
        return surface
    return _surface(polydata(surface).decimate(1.0 - faces / len(surface.faces)))


def enclosed_volume(surface: Surface) -> float:
    """Volume inside a closed surface, m^3, by the divergence theorem; positive for outward normals."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def face_areas(surface: Surface) -> NDArray[np.float64]:
    """Area of each face, m^2."""
    return facet_areas(surface.vertices, surface.faces)


def merged(sheets: list[Surface]) -> Surface:
    """Join sheets into one, with vertices at the same place made one, so that they meet without an edge between."""
    poly = pv.merge([polydata(s) for s in sheets], merge_points=False)
    poly = poly.extract_surface(algorithm=None).clean(tolerance=1e-7, absolute=True)
    return Surface(np.asarray(poly.points, dtype=np.float64), np.asarray(poly.regular_faces, dtype=np.int32))


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Area-weighted unit normals, shape (V, 3); vertices without a face get +z."""
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices, dtype=np.float64)
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(faces[:, corner], face_normals[:, axis], minlength=len(vertices))
    length = np.linalg.norm(normals, axis=1)
    normals[length < 1e-15] = (0.0, 0.0, 1.0)
    return unit(normals)


def polydata(surface: Surface) -> pv.PolyData:
    """Wrap a surface as VTK's data structure."""
    faces: Any = surface.faces.astype(np.int64)  # PyVista's annotation knows no NumPy integer
    return pv.PolyData.from_regular_faces(surface.vertices, faces)


def _surface(polydata: pv.PolyData) -> Surface:
    faces = np.ascontiguousarray(polydata.regular_faces, dtype=np.int32)
    return Surface(np.asarray(polydata.points, dtype=np.float64), faces)

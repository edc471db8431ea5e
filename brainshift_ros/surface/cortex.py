"""The fine outer cortical surface: what a laser range scanner sees after the dura is opened."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.filters import threshold_multiotsu

from brainshift_ros.image.labels import largest_component
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.surface.facets import compact, components
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import decimate, face_areas, isosurface, smooth_taubin
from brainshift_ros.units import m_to_mm

#: Grooves narrower than twice this are bridged, as the arachnoid does.
CLOSING_MM = 3.0
#: No groove is deeper than this below the brain mask: fissures and ventricles are not cortex that a scanner sees.
DEPTH_MM = 8.0
#: Standard deviation of the blur that rounds the voxels' steps.
SMOOTHING_MM = 0.8
_FACES_PER_M2 = 1.6e6  # edges of about 1.2 mm


def cortical_surface(
    t1: Volume, labels: Volume, *, closing_mm: float = CLOSING_MM, smoothing_mm: float = SMOOTHING_MM
) -> Surface:
    """Outer surface of the tissue inside the brain mask, with sulcal grooves a few millimetres deep.

    Tissue is what is brighter than cerebrospinal fluid on the T1 (lowest of Otsu's two thresholds in the outer shell).

    Parameters
    ----------
    t1, labels
        On the same grid.
    closing_mm, smoothing_mm
        Grooves narrower than twice `closing_mm` are bridged; `smoothing_mm` is the blur of the tissue's indicator.

    Returns
    -------
    Surface
        Closed, edges of about 1.2 mm, outward normals.
    """
    voxel_mm = np.linalg.norm(m_to_mm(t1.T_patient_voxel[:3, :3]), axis=0)
    pad = int(np.ceil(closing_mm / voxel_mm.min())) + 3
    mask = np.pad(ndimage.binary_fill_holes(labels.data > 0), pad)
    depth_mm = ndimage.distance_transform_edt(mask, voxel_mm)
    intensity = np.pad(ndimage.gaussian_filter(t1.data.astype(np.float32), 0.5), pad)
    shell = mask & (depth_mm < DEPTH_MM) & (intensity > 0)
    fluid, _ = threshold_multiotsu(intensity[shell], classes=3)
    tissue = mask & ((intensity > fluid) | np.pad(labels.data == Region.TUMOR, pad)) | (depth_mm >= DEPTH_MM)
    closed = _close(tissue, voxel_mm, closing_mm) & mask
    solid = ndimage.binary_fill_holes(largest_component(closed))
    field = ndimage.gaussian_filter(solid.astype(np.float32), smoothing_mm / voxel_mm)
    surface = _outermost(isosurface(field, 0.5, t1.T_patient_voxel, pad))
    surface = smooth_taubin(surface, iterations=10, pass_band=0.1)
    return decimate(surface, int(_FACES_PER_M2 * face_areas(surface).sum()))


def _close(mask: NDArray[np.bool_], voxel_mm: NDArray[np.float64], radius_mm: float) -> NDArray[np.bool_]:
    """Morphological closing by a ball, through distances."""
    dilated = ndimage.distance_transform_edt(~mask, voxel_mm) <= radius_mm
    return ndimage.distance_transform_edt(dilated, voxel_mm) > radius_mm


def _outermost(surface: Surface) -> Surface:
    """Keep the part of a surface with the most faces."""
    pairs = np.vstack([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]]])
    part = components(len(surface.vertices), pairs)[surface.faces[:, 0]]
    return Surface(*compact(surface.vertices, surface.faces[part == np.argmax(np.bincount(part))]))

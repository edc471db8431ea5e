"""The MNI152 template that ships with nilearn, with the labels that it lacks, defined by landmarks."""

from __future__ import annotations

from types import ModuleType

import nibabel as nib
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator, RegularGridInterpolator
from scipy.ndimage import binary_fill_holes

from brainshift_ros.geometry import transform_points
from brainshift_ros.image.labels import largest_component
from brainshift_ros.image.landmarks import BrainstemLandmarks, SeptaLandmarks, TemplateLandmarks, read_template_landmarks
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.resources import resource
from brainshift_ros.units import affine_mm_to_m, m_to_mm

_SHEET_STEP_MM = 1.0  # the smooth sheet is tabulated at this step, then interpolated
_LANDMARK_FILE = "config/template_mni152.yaml"


def template_landmarks() -> TemplateLandmarks:
    """Read the template's landmarks from the file that ships with the package."""
    return read_template_landmarks(resource(_LANDMARK_FILE))


def template_t1() -> Volume:
    """Load the skull-stripped T1, 197 x 233 x 189 voxels of 1 mm, float32 in 0 to 1."""
    return _volume(_datasets().load_mni152_template(resolution=1), np.float32)


def template_labels(landmarks: TemplateLandmarks) -> Volume:
    """Left and right cerebrum, cerebellum and brainstem of the template.

    The brain mask is the image's own. Cerebellum lies under the tentorium, inside its outline; brainstem inside the
    tube of its landmarks; the midsagittal plane parts left from right.

    Returns
    -------
    Volume
        uint8, values of :class:`Region`.
    """
    mask = _volume(_datasets().load_mni152_brain_mask(resolution=1), np.uint8)
    brain = binary_fill_holes(largest_component(mask.data > 0))
    voxels = np.argwhere(brain)
    points_mm = m_to_mm(transform_points(mask.T_patient_voxel, voxels))
    right = landmarks.midsagittal_plane.height_mm(points_mm) >= 0.0
    region = np.where(right, Region.RIGHT_CEREBRUM, Region.LEFT_CEREBRUM).astype(np.uint8)
    region[under_tentorium(points_mm, landmarks.septa)] = Region.CEREBELLUM
    region[in_brainstem(points_mm, landmarks.brainstem)] = Region.BRAINSTEM
    data = np.zeros(mask.shape, dtype=np.uint8)
    data[brain] = region
    return Volume(_without_crumbs(data, mask.T_patient_voxel, landmarks), mask.T_patient_voxel)


def under_tentorium(points_mm: NDArray[np.float64], landmarks: SeptaLandmarks) -> NDArray[np.bool_]:
    """Whether points, shape (n, 3) in mm, lie below the tentorium and inside its outline, its notch included."""
    left, right = landmarks.tentorium.left, landmarks.tentorium.right_side
    sinus = np.asarray(landmarks.straight_sinus)
    known = np.vstack([sinus, *(np.vstack([s.attachment, s.free_edge, np.reshape(s.surface, (-1, 3))]) for s in (left, right))])
    # One closed outline of both sides: left attachment forward, straight across the notch, right attachment back.
    outline = np.vstack([sinus[-1:], left.attachment, right.attachment[::-1]])[:, :2]
    low, high = outline.min(axis=0), outline.max(axis=0)
    x, y = (np.arange(low[k], high[k] + _SHEET_STEP_MM, _SHEET_STEP_MM) for k in (0, 1))
    spline = RBFInterpolator(known[:, :2], known[:, 2], kernel="thin_plate_spline")
    heights = spline(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)).reshape(len(x), len(y))
    below = np.zeros(len(points_mm), dtype=bool)
    candidate = np.flatnonzero(points_mm[:, 2] < known[:, 2].max())
    candidate = candidate[_inside(points_mm[candidate, :2], outline)]
    height = RegularGridInterpolator((x, y), heights)
    below[candidate] = points_mm[candidate, 2] < height(points_mm[candidate, :2])
    return below


def in_brainstem(points_mm: NDArray[np.float64], landmarks: BrainstemLandmarks) -> NDArray[np.bool_]:
    """Whether points, shape (n, 3) in mm, lie inside the tube of cross sections and below its top plane."""
    sections = landmarks.sections[::-1]
    heights = [s.z for s in sections]
    x, y, z = points_mm.T
    front = np.interp(z, heights, [s.y_anterior for s in sections])
    back = np.interp(z, heights, [s.y_posterior for s in sections])
    width = np.interp(z, heights, [s.half_width for s in sections])
    n = landmarks.exponent
    radial = np.abs(x / width) ** n + np.abs((y - 0.5 * (front + back)) / (0.5 * (front - back))) ** n
    within = (z >= heights[0]) & (z <= heights[-1]) & (landmarks.top_plane.height_mm(points_mm) <= 0.0)
    return within & (radial <= 1.0)


def _inside(points: NDArray[np.float64], polygon: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Even-odd rule, for points (n, 2) and a closed polygon (m, 2)."""
    inside = np.zeros(len(points), dtype=bool)
    x, y = points.T
    for (x1, y1), (x2, y2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y1 != y2:
            inside ^= ((y1 > y) != (y2 > y)) & (x < (x2 - x1) * (y - y1) / (y2 - y1) + x1)
    return inside


def _without_crumbs(
    data: NDArray[np.uint8], T_patient_voxel: NDArray[np.float64], landmarks: TemplateLandmarks
) -> NDArray[np.uint8]:
    """Give pieces that the landmark surfaces cut off from cerebellum or brainstem back to the cerebrum."""
    data = data.copy()
    for region in (Region.CEREBELLUM, Region.BRAINSTEM):
        crumbs = (data == region) & ~largest_component(data == region)
        points_mm = m_to_mm(transform_points(T_patient_voxel, np.argwhere(crumbs)))
        right = landmarks.midsagittal_plane.height_mm(points_mm) >= 0.0
        data[crumbs] = np.where(right, Region.RIGHT_CEREBRUM, Region.LEFT_CEREBRUM)
    return data


def _datasets() -> ModuleType:
    # Imported here: it takes two seconds, and a patient with labels of their own never needs it.
    from nilearn import datasets

    return datasets


def _volume(image: nib.Nifti1Image, dtype: type) -> Volume:
    return Volume(np.asarray(image.dataobj).astype(dtype), affine_mm_to_m(image.affine))

"""Registration engines under one interface: template, its brain, patient, tumour -> template map."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray

from brainshift_ros.experiments import registration_ants
from brainshift_ros.geometry import T_LPS_RAS
from brainshift_ros.image.io import write_volume
from brainshift_ros.image.itk import read_displacement_image
from brainshift_ros.image.volume import Volume
from brainshift_ros.segmentation.register import register_linear, register_nonrigid
from brainshift_ros.segmentation.settings import SegmentationSettings
from brainshift_ros.segmentation.template_map import TemplateMap
from brainshift_ros.segmentation.working_images import WorkingImages, working_images
from brainshift_ros.units import m_to_mm, mm_to_m

Engine = Callable[[Volume, NDArray[np.bool_], Volume, Volume | None], TemplateMap]

_LINEAR_MM = 4.0
_IMAGES = ("fixed", "moving", "fixed_mask", "known")
_TIMEOUT_S = 7200.0


def greedy_engine(settings: SegmentationSettings) -> Engine:
    """Return the product's own way."""

    def engine(template: Volume, brain: NDArray[np.bool_], t1: Volume, tumor: Volume | None) -> TemplateMap:
        coarse = working_images(template, brain, t1, tumor, max(_LINEAR_MM, settings.spacing_mm), settings.margin_mm)
        fine = working_images(template, brain, t1, tumor, settings.spacing_mm, settings.margin_mm)
        return register_nonrigid(fine, register_linear(coarse, settings), settings).template_map

    return engine


def demons_engine(settings: SegmentationSettings) -> Engine:
    """Greedy's linear part, so that only the non-rigid parts differ; then SimpleITK's diffeomorphic demons."""

    def engine(template: Volume, brain: NDArray[np.bool_], t1: Volume, tumor: Volume | None) -> TemplateMap:
        coarse = working_images(template, brain, t1, tumor, _LINEAR_MM, settings.margin_mm)
        linear = register_linear(coarse, settings)
        images = working_images(template, brain, t1, tumor, settings.spacing_mm, settings.margin_mm)
        with tempfile.TemporaryDirectory(prefix="brainshift-bench-") as name:
            folder = Path(name)
            _write(images, folder)
            sitk.WriteImage(_demons(folder, linear.T_affine, settings), str(folder / "warp.nii"))
            displacement, grid = read_displacement_image(folder / "warp.nii")
        return TemplateMap.create(
            linear.T_patient_template, linear.T_affine, displacement.astype(np.float32), grid.T_patient_voxel
        )

    return engine


def ants_engine(python: str, settings: SegmentationSettings) -> Engine:
    """ANTs' own rigid, affine and SyN, run by another interpreter on the same images."""

    def engine(template: Volume, brain: NDArray[np.bool_], t1: Volume, tumor: Volume | None) -> TemplateMap:
        images = working_images(template, brain, t1, tumor, settings.spacing_mm, settings.margin_mm)
        with tempfile.TemporaryDirectory(prefix="brainshift-bench-") as name:
            folder = Path(name)
            _write(images, folder)
            command = [python, str(registration_ants.__file__), str(folder), str(settings.threads)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=_TIMEOUT_S)
            displacement, grid = read_displacement_image(folder / "warp.nii.gz")
            T_affine = _ras_matrix(sitk.ReadTransform(str(folder / "affine.mat")))
        # The rotation nearest to the linear part (polar decomposition); as in the product, all stretch belongs to T2.
        u, _, vt = np.linalg.svd(T_affine[:3, :3])
        T_rigid = T_affine.copy()
        T_rigid[:3, :3] = u @ vt
        return TemplateMap.create(T_rigid, T_affine, displacement.astype(np.float32), grid.T_patient_voxel)

    return engine


def _write(images: WorkingImages, folder: Path) -> None:
    for field in _IMAGES:
        write_volume(folder / f"{field}.nii", getattr(images, field))


def _demons(folder: Path, T_affine: NDArray[np.float64], settings: SegmentationSettings) -> sitk.Image:
    """Displacement of the template's points, mm and LPS, found from coarse to fine like greedy's."""
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(settings.threads)
    fixed, moving, fixed_mask, known = (sitk.ReadImage(str(folder / f"{name}.nii"), sitk.sitkFloat32) for name in _IMAGES)
    affine = _sitk_affine(T_affine)
    moving, known = (sitk.Resample(image, fixed, affine, sitk.sitkLinear) for image in (moving, known))
    # Demons takes no mask, and compares intensities as they are: both images are blanked where the metric should not
    # look, and the patient's histogram is brought to the template's.
    counted = sitk.Cast((fixed_mask > 0.5) & (known > 0.5), sitk.sitkFloat32)
    fixed, moving = fixed * counted, sitk.HistogramMatching(moving * counted, fixed * counted, 256, 15, True)
    demons = sitk.DiffeomorphicDemonsRegistrationFilter()
    demons.SetStandardDeviations(1.5)
    displacement = sitk.Image(fixed.GetSize(), sitk.sitkVectorFloat64, 3)
    displacement.CopyInformation(fixed)
    for shrink, iterations in zip((4, 2, 1), settings.iterations, strict=True):
        small = [_shrunk(image, shrink) for image in (fixed, moving)]
        demons.SetNumberOfIterations(iterations)
        displacement = demons.Execute(*small, sitk.Resample(displacement, small[0]))
    return sitk.Resample(displacement, fixed)


def _sitk_affine(T: NDArray[np.float64]) -> sitk.AffineTransform:
    lps = T_LPS_RAS @ T @ T_LPS_RAS
    return sitk.AffineTransform(lps[:3, :3].ravel().tolist(), m_to_mm(lps[:3, 3]).tolist())


def _shrunk(image: sitk.Image, factor: int) -> sitk.Image:
    sigma = image.GetSpacing()[0] * factor / 2.0
    return image if factor == 1 else sitk.Shrink(sitk.SmoothingRecursiveGaussian(image, sigma), [factor] * 3)


def _ras_matrix(transform: sitk.Transform) -> NDArray[np.float64]:
    """Return the 4x4 matrix, RAS and metres, of a transform that is affine in fact; from where it takes four points."""
    flip = np.diag(T_LPS_RAS)[:3]
    corners = np.vstack([np.zeros(3), np.eye(3)])
    moved = np.array([transform.TransformPoint((m_to_mm(corner) * flip).tolist()) for corner in corners])
    moved = mm_to_m(moved * flip)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = (moved[1:] - moved[0]).T, moved[0]
    return T

"""Template to patient: rigid, affine, non-rigid (thesis figures 3 and 19)."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import transform_points
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.io import write_volume
from brainshift_ros.image.itk import read_displacement_image
from brainshift_ros.image.volume import Volume
from brainshift_ros.segmentation.greedy import run_greedy
from brainshift_ros.segmentation.initial import brain_centres
from brainshift_ros.segmentation.likeness import likeness
from brainshift_ros.segmentation.settings import SegmentationSettings
from brainshift_ros.segmentation.template_map import TemplateMap
from brainshift_ros.segmentation.working_images import WorkingImages
from brainshift_ros.units import m_to_mm, mm_to_m

_METRICS = {"wncc": "WNCC 2x2x2", "nmi": "NMI"}
# Of each step, and of the sum of steps. Wider than greedy's own 1.7 and 0.7 voxels: the same accuracy, far from folding.
_SMOOTHING = "-s 2vox 1vox"


@dataclass(frozen=True)
class LinearRegistration:
    """What precedes the non-rigid part.

    Attributes
    ----------
    T_patient_template
        Rigid, shape (4, 4): the thesis's T1.
    T_affine
        Shape (4, 4), the rigid part included.
    times_s
        Wall time of each stage.
    cpu_s
        Processor time of all stages.
    """

    T_patient_template: NDArray[np.float64]
    T_affine: NDArray[np.float64]
    times_s: Mapping[str, float]
    cpu_s: float


@dataclass(frozen=True)
class Registration:
    """A template map and what the non-rigid part cost.

    Attributes
    ----------
    template_map
        Rigid T1 and non-rigid T2.
    time_s, cpu_s
        Wall and processor time.
    peak_bytes
        Largest resident set size of greedy.
    """

    template_map: TemplateMap
    time_s: float
    cpu_s: float
    peak_bytes: int


def register_linear(
    images: WorkingImages, settings: SegmentationSettings, waiting: Callable[[float], None] | None = None
) -> LinearRegistration:
    """Rigid part by normalised mutual information (Studholme et al. 1999), from several starts; then the affine part.

    The template is the fixed image: the metric is summed over its voxels near the brain.

    Parameters
    ----------
    images
        Of 4 mm or so: at 8 mm and coarser, a stripped brain and a whole head look alike in wrong places too.
    settings
        Threads, seed and timeout.
    waiting
        Called a few times a second with the seconds that greedy has run.

    Raises
    ------
    InputError
        greedy failed or took too long.
    """
    times: dict[str, float] = {}
    with _folder() as name:
        folder = Path(name)
        _write_images(folder, images)
        rigid_options = f"{_images('healthy')} -a -m NMI -dof 6 -o rigid.mat {_common(settings)}"
        begin = time.monotonic()
        found, cpu_s = [], 0.0
        for start, search in _starts(images):
            _write_affine(folder / "start.mat", start)
            worker = run_greedy(folder, f"{rigid_options} {search}", "rigid", settings.timeout_s, waiting)
            found.append(_read_affine(folder / "rigid.mat"))
            cpu_s += worker.cpu_s
        rigid = max(found, key=lambda T: likeness(images, partial(transform_points, T)).score)
        times["rigid"] = time.monotonic() - begin
        begin = time.monotonic()
        _write_affine(folder / "rigid.mat", rigid)
        command = f"{_images('known')} -a -m WNCC 2x2x2 -dof 12 -ia rigid.mat -n 60 -o affine.mat {_common(settings)}"
        worker = run_greedy(folder, command, "affine", settings.timeout_s, waiting)
        affine = _read_affine(folder / "affine.mat")
        times["affine"] = time.monotonic() - begin
    return LinearRegistration(rigid, affine, times, cpu_s + worker.cpu_s)


def register_nonrigid(
    images: WorkingImages,
    linear: LinearRegistration,
    settings: SegmentationSettings,
    waiting: Callable[[float], None] | None = None,
) -> Registration:
    """Non-rigid part: a diffeomorphism composed of smoothed steps (Joshi et al. 2004, Yushkevich et al. 2016).

    Parameters
    ----------
    images
        At the resolution of the settings.
    linear
        Where to start from.
    settings
        Metric and effort.
    waiting
        Called a few times a second with the seconds that greedy has run.

    Raises
    ------
    InputError
        greedy failed or took too long.
    """
    begin = time.monotonic()
    with _folder() as name:
        folder = Path(name)
        _write_images(folder, images)
        _write_affine(folder / "affine.mat", linear.T_affine)
        levels = "x".join(str(n) for n in settings.iterations)
        command = f"{_images('known')} -it affine.mat -m {_METRICS[settings.metric]} -n {levels} {_SMOOTHING}"
        command += f" -wp 0.01 -o warp.nii {_common(settings)}"
        worker = run_greedy(folder, command, "non-rigid", settings.timeout_s, waiting)
        displacement, grid = read_displacement_image(folder / "warp.nii")
    template_map = TemplateMap.create(
        linear.T_patient_template, linear.T_affine, displacement.astype(np.float32), grid.T_patient_voxel
    )
    return Registration(template_map, time.monotonic() - begin, worker.cpu_s, worker.peak_bytes)


def _folder() -> tempfile.TemporaryDirectory[str]:
    # The watcher of the process removes the folder as well if this process dies.
    return tempfile.TemporaryDirectory(prefix="brainshift-segmentation-", ignore_cleanup_errors=True)


def _images(moving_mask: str) -> str:
    return f"-i fixed.nii moving.nii -gm fixed_mask.nii -mm {moving_mask}.nii"


def _common(settings: SegmentationSettings) -> str:
    return f"-threads {settings.threads} -seed {settings.seed}"


def _starts(images: WorkingImages) -> Iterator[tuple[NDArray[np.float64], str]]:
    """Yield rigid starts and how to search from each: down from half resolution, or at random nearby."""
    points = Grid.of(images.fixed).centres(np.argwhere(images.fixed_mask.data))
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    below_vertex, between = brain_centres(images.moving)
    for centre, search in ((below_vertex, "-n 100x50"), (between, "-n 100x50"), (below_vertex, "-search 200 12 15 -n 100")):
        T_patient_template = np.eye(4)
        T_patient_template[:3, 3] = centre - middle
        yield T_patient_template, f"-ia start.mat {search}"


def _write_images(folder: Path, images: WorkingImages) -> None:
    for field in fields(images):
        volume: Volume = getattr(images, field.name)
        write_volume(folder / f"{field.name}.nii", volume)


def _write_affine(path: Path, T: NDArray[np.float64]) -> None:
    """Write a RAS transform as greedy keeps it: a matrix of text, millimetres to millimetres."""
    T_mm = T.copy()
    T_mm[:3, 3] = m_to_mm(T[:3, 3])
    np.savetxt(path, T_mm, fmt="%.12g")


def _read_affine(path: Path) -> NDArray[np.float64]:
    T = np.loadtxt(path)
    T[:3, 3] = mm_to_m(T[:3, 3])
    return T

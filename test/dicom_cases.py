"""Real DICOM series on disk, written by SimpleITK as a scanner's export would be."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import SimpleITK as sitk  # noqa: N813

STUDY_UID = "1.2.826.0.1.3680043.2.1125.1"


def image_of(data: np.ndarray, direction: np.ndarray, spacing: Sequence[float] = (0.9, 1.1, 1.5)) -> sitk.Image:
    """An image of voxels (i, j, k) whose axes point along the columns of `direction`, LPS."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(data.T))
    image.SetSpacing([float(edge) for edge in spacing])
    image.SetDirection(np.asarray(direction, dtype=float).ravel().tolist())
    image.SetOrigin((-31.0, 17.5, 8.25))
    return image


def write_series(
    folder: Path,
    image: sitk.Image,
    *,
    number: int = 3,
    description: str = "T1 MPRAGE",
    slopes: Sequence[int] | None = None,
    intercept: int = 0,
    tilt: float = 0.0,
    leave_out: Sequence[int] = (),
    extra: Mapping[str, str] | None = None,
    names: str = "IM{:04d}.dcm",
) -> Path:
    """Write one file a slice, in an order of names that is not that of their places.

    With `slopes`, one a slice, the stored integers are (value - intercept) / slope, cut off. `tilt` shifts slices
    along y in proportion to their height, as a tilted gantry does.
    """
    folder.mkdir(parents=True, exist_ok=True)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    direction = image.GetDirection()
    series_uid = f"{STUDY_UID}.{number}.{time.monotonic_ns()}"
    tags = {
        # The writer would turn a classic MR with a slope into an enhanced one: it is written as CT and made MR afterwards.
        "0008|0060": "MR" if slopes is None else "CT",
        "0020|000d": STUDY_UID,
        "0020|000e": series_uid,
        "0020|0011": str(number),
        "0008|103e": description,
        "0020|0037": "\\".join(f"{direction[k]:.10f}" for k in (0, 3, 6, 1, 4, 7)),
    }
    order = np.random.default_rng(number).permutation(image.GetSize()[2])
    for place, name in enumerate(order):
        if place in leave_out:
            continue
        piece = image[:, :, place]
        x, y, z = image.TransformIndexToPhysicalPoint((0, 0, place))
        own = {
            "0008|0018": f"{series_uid}.{place + 1}",
            "0020|0032": f"{x:.8f}\\{y + tilt * z:.8f}\\{z:.8f}",
            "0020|0013": str(place + 1),
        }
        if slopes is not None:
            own |= {"0028|1052": str(intercept), "0028|1053": str(slopes[place])}
        for key, value in {**tags, **own, **(extra or {})}.items():
            piece.SetMetaData(key, value)
        writer.SetFileName(str(folder / names.format(int(name))))
        writer.Execute(piece)
        if slopes is not None:
            made_mr(folder / names.format(int(name)))
    return folder


def made_mr(path: Path) -> None:
    """Turn a CT image file into an MR one, in place."""
    changed = path.read_bytes()
    for old, new in (
        (b"1.2.840.10008.5.1.4.1.1.2\0", b"1.2.840.10008.5.1.4.1.1.4\0"),
        (b"\x08\x00\x60\x00\x02\x00\x00\x00CT", b"\x08\x00\x60\x00\x02\x00\x00\x00MR"),
    ):
        assert old in changed
        changed = changed.replace(old, new)
    path.write_bytes(changed)

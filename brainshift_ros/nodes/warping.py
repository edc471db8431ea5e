"""Warp the MR in a process of its own: it takes seconds of pure computation that the node must not feel."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from brainshift_ros.errors import InputError
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.field_file import write_field


class ImageWarper:
    """Runs `brainshift warp` on the latest field.

    Parameters
    ----------
    image_file
        The MR; empty if the node was started without one.
    output_dir
        Where field, warped image and transform go.
    """

    def __init__(self, image_file: str, output_dir: str) -> None:
        self._image_file = image_file
        self._output_dir = Path(output_dir)
        self._process: subprocess.Popen[str] | None = None

    def warp(self, field: DisplacementField) -> Path:
        """Write field.h5, warped.nii.gz and displacement.nii.gz; return the warped image's path.

        Raises
        ------
        InputError
            No image was given, the folder cannot be made, or `brainshift warp` refused.
        """
        if not self._image_file:
            raise InputError("image_file", "is not set", "start the node with -p image_file:=PATH, or `brainshift run --image`")
        try:
            self._output_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError("output_dir", f"{self._output_dir} cannot be made ({error})", "choose another folder") from error
        field_file = self._output_dir.resolve() / "field.h5"
        warped = field_file.with_name("warped.nii.gz")
        transform = field_file.with_name("displacement.nii.gz")
        write_field(field_file, field)
        arguments = [str(field_file), self._image_file, "-o", str(warped), "--transform", str(transform)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "brainshift_ros.cli.main", "warp", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        output, _ = self._process.communicate()
        if self._process.returncode != 0:
            raise InputError(
                self._image_file, f"could not be warped: {output.strip()[-500:]}", "mend what it names and call again"
            )
        return warped

    def stop(self) -> None:
        """End the process, if one runs."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()

"""Warp the MR in a process of its own: it takes seconds of pure computation that the node must not feel."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from brainshift_ros.errors import InputError
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.field_file import write_field
from brainshift_ros.worker_process import run_worker

FIELD, WARPED, TRANSFORM, CHECKS = "field.h5", "warped.nii.gz", "displacement.nii.gz", "warped.json"

#: An image of 512^3 voxels takes about a minute.
TIME_LIMIT_S = 600.0


@dataclass(frozen=True)
class WarpedFile:
    """The warped image's path, and what a person should know of it."""

    path: Path
    warnings: tuple[str, ...]


class ImageWarper:
    """Runs `brainshift warp` on a field; the process ends with the node, however that ends.

    Parameters
    ----------
    image_file
        The MR; empty if the node was started without one.
    output_dir
        Where field, warped image, transform and the checks of the map go.
    """

    def __init__(self, image_file: str, output_dir: str) -> None:
        self._image_file = image_file
        self._output_dir = Path(output_dir)

    def warp(self, field: DisplacementField, wanted: Callable[[], bool]) -> WarpedFile:
        """Write field.h5, warped.nii.gz, displacement.nii.gz and warped.json, moved into place once all are whole.

        Parameters
        ----------
        field
            The shift.
        wanted
            Asked a few times a second; the process is ended once this is False.

        Raises
        ------
        InputError
            No image was given, the folder cannot be made, `brainshift warp` refused or was killed, or it is no longer wanted.
        """
        if not self._image_file:
            raise InputError("image_file", "is not set", "start the node with -p image_file:=PATH, or `brainshift run --image`")
        try:
            self._output_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError("output_dir", f"{self._output_dir} cannot be made ({error})", "choose another folder") from error
        output = self._output_dir.resolve()

        def check(_: float = 0.0) -> None:
            if not wanted():
                raise InputError("warp_image", "was given up: the case is over", "call again when the next one has a field")

        # On the same file system, so that what is finished can be moved in one step.
        with tempfile.TemporaryDirectory(prefix=".warp-", dir=output, ignore_cleanup_errors=True) as name:
            folder = Path(name)
            write_field(folder / FIELD, field)
            image = str(Path(self._image_file).resolve())
            arguments = ["warp", FIELD, image, "-o", WARPED, "--transform", TRANSFORM, "--json", CHECKS]
            try:
                ended = run_worker("brainshift_ros.cli.main", arguments, folder, timeout_s=TIME_LIMIT_S, waiting=check)
            except (OSError, ValueError) as error:  # the watcher itself was killed, or the time limit passed
                raise InputError("warp_image", f"its process is gone ({error})", "call again") from error
            if ended.status < 0:
                raise InputError("warp_image", f"its process was ended by signal {-ended.status}", "call again")
            if ended.status != 0:
                problem = f"could not be warped: {ended.last_line}"
                raise InputError(self._image_file, problem, "mend what it names and call again")
            warnings = json.loads((folder / CHECKS).read_text(encoding="utf-8"))["warnings"]
            check()
            for file in (FIELD, TRANSFORM, CHECKS, WARPED):
                os.replace(folder / file, output / file)
        return WarpedFile(output / WARPED, tuple(warnings))

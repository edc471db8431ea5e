"""What a person marked in the pictures of two scans, as YAML: pairs of pixels, and ends of vessels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from brainshift_ros.correspondence.guided_vessels import VesselEnds, vessel_pairs
from brainshift_ros.correspondence.guides import Guides
from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.yaml_files import read_yaml, validated

_EXAMPLE = "config/guides_example.yaml"

_Pixel = tuple[float, float]


@dataclass(frozen=True)
class GuideMarks:
    """Marks of a person; pixels are (row, column) in the textures of the first and of the later scan.

    Attributes
    ----------
    first_px, later_px
        Shape (n, 2): pairs that show the same spot of the cortex; n may be zero where vessels are marked.
    vessels
        Vessels marked by their ends in both scans.
    """

    first_px: NDArray[np.float64]
    later_px: NDArray[np.float64]
    vessels: tuple[VesselEnds, ...] = ()

    def guides(self, first: OrganisedScan, later: OrganisedScan) -> Guides:
        """Pairs that guide the correspondence of two scans: those marked, and those along the marked vessels.

        Raises
        ------
        InputError
            A mark lies outside its picture, or a vessel cannot be followed between its ends.
        """
        _check_inside(self.first_px, first, "first")
        _check_inside(self.later_px, later, "later")
        if not self.vessels:
            return Guides(self.first_px, self.later_px)
        for ends in self.vessels:
            _check_inside(ends.first_px, first, "first")
            _check_inside(ends.later_px, later, "later")
        along = vessel_pairs(first, later, self.vessels)
        return Guides(np.concatenate([self.first_px, along.first_px]), np.concatenate([self.later_px, along.later_px]))


def _check_inside(pixels: NDArray[np.float64], scan: OrganisedScan, which: str) -> None:
    rows, columns = scan.rgb.shape[:2]
    for row, column in pixels:
        if not (0.0 <= row <= rows - 1 and 0.0 <= column <= columns - 1):
            problem = f"[{row:g}, {column:g}] lies outside the {which} scan of {rows} rows and {columns} columns"
            raise InputError("guides", problem, "give row and column, counted from 0 at the top left")


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Vessel(_Part):
    first_px: tuple[_Pixel, _Pixel]
    later_px: tuple[_Pixel, _Pixel]


class _GuidesFile(_Part):
    pairs_px: tuple[tuple[float, float, float, float], ...] = ()
    vessels: tuple[_Vessel, ...] = ()


def read_guides(path: str | Path) -> GuideMarks:
    """Read a guides file.

    ::

        pairs_px:                                  # row and column in the first, row and column in the later picture
          - [212, 310, 230, 322]
        vessels:                                   # both ends of a vessel in each picture, in the same order
          - {first_px: [[180, 250], [300, 262]], later_px: [[198, 262], [318, 275]]}

    Raises
    ------
    InputError
        The file is missing, not YAML, a key is unknown or wrong, or it marks nothing.
    """
    content = validated(path, _GuidesFile, read_yaml(path, "guides file", _EXAMPLE), _EXAMPLE)
    if not content.pairs_px and not content.vessels:
        raise InputError(path, "marks nothing", f"give pairs_px or vessels; see {_EXAMPLE}")
    pairs = np.array(content.pairs_px, dtype=np.float64).reshape(-1, 4)
    vessels = tuple(VesselEnds(np.array(item.first_px), np.array(item.later_px)) for item in content.vessels)
    return GuideMarks(pairs[:, :2], pairs[:, 2:], vessels)

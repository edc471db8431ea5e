"""How good a map is: does it fold, and how well do its inverse, and the file that samples it, undo the shift."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.jacobian import jacobian_of_cells, jacobian_of_elements
from brainshift_ros.image.grid import Grid, reached, trilinear
from brainshift_ros.mesh.nearest import boundary_faces
from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm

#: Errors are measured at this many random places of each kind.
_SAMPLES = 5_000


@dataclass(frozen=True)
class Errors:
    """Lengths of errors, metres: mean, 95th percentile and largest; 0 where there was nothing to measure."""

    mean: float = 0.0
    p95: float = 0.0
    largest: float = 0.0

    @staticmethod
    def of(vectors: NDArray) -> Errors:
        """Summarise error vectors of shape (n, 3)."""
        if len(vectors) == 0:
            return Errors()
        length = np.linalg.norm(vectors, axis=1)
        return Errors(float(length.mean()), float(np.percentile(length, 95)), float(length.max()))

    def to_json(self) -> dict[str, float]:
        """In mm."""
        return {
            "mean_mm": float(m_to_mm(self.mean)),
            "p95_mm": float(m_to_mm(self.p95)),
            "max_mm": float(m_to_mm(self.largest)),
        }


@dataclass(frozen=True)
class MapChecks:
    """Checks of a deformation and of its inverse on an output grid.

    A Jacobian determinant of 1 keeps volume; one of 0 or below folds.

    Attributes
    ----------
    largest_shift
        Largest displacement of the brain, metres.
    jacobian_brain, folded_elements
        Smallest determinant over the mesh's elements, and how many are turned inside out.
    jacobian_around
        Smallest determinant of the field around the brain, on its own grid.
    jacobian_image, folded_cells, folded_cells_at_sheets, folded_cells_around
        Of the inverse on the output grid, between voxel centres, as a resampler interpolates it: the smallest, how many
        cells fold, and how many of those lie within a voxel of the septa or the brain's surface, or wholly outside the
        brain. At septa the brain slides; the exact map does not fold there, but no interpolation can hold a jump.
    inverse_brain, inverse_around
        How far forward after inverse is from identity, at voxel centres.
    sampling_brain, sampling_sheets
        How far the inverse, interpolated between voxel centres, is from the exact one at points of the brain: more than a
        voxel away from the septa and the surface, and within it.
    warnings
        What a person should know.
    """

    largest_shift: float
    jacobian_brain: float
    folded_elements: int
    jacobian_around: float
    jacobian_image: float
    folded_cells: int
    folded_cells_at_sheets: int
    folded_cells_around: int
    inverse_brain: Errors
    inverse_around: Errors
    sampling_brain: Errors
    sampling_sheets: Errors
    warnings: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """For summaries; lengths in mm."""
        return {
            "largest_shift_mm": float(m_to_mm(self.largest_shift)),
            "jacobian_min": {"brain": self.jacobian_brain, "around": self.jacobian_around, "image": self.jacobian_image},
            "folded_elements": self.folded_elements,
            "folded_cells": self.folded_cells,
            "folded_cells_at_sheets": self.folded_cells_at_sheets,
            "folded_cells_around": self.folded_cells_around,
            "inverse_error": {"brain": self.inverse_brain.to_json(), "around": self.inverse_around.to_json()},
            "sampling_error": {"brain": self.sampling_brain.to_json(), "at_sheets": self.sampling_sheets.to_json()},
            "warnings": list(self.warnings),
        }


def check_map(
    deformation: Deformation, inverse: NDArray[np.float32], grid: Grid, owner: NDArray[np.int32], seed: int = 0
) -> MapChecks:
    """Check a deformation, and its inverse as sampled on an output grid.

    Parameters
    ----------
    deformation
        The map.
    inverse
        ``deformation.inverse_on(grid)``.
    grid
        The output grid.
    owner
        ``deformation.owner_now(grid)``.
    seed
        Chooses the places where errors are measured.
    """
    rng = np.random.default_rng(seed)
    sheets = _Sheets(deformation, float(np.linalg.norm(grid.voxel_edges)))
    ratio = jacobian_of_elements(deformation.field)
    folded_elements = int(np.count_nonzero(ratio <= 0.0))
    around = deformation.surroundings
    cells = jacobian_of_cells(inverse, grid)
    folded = np.argwhere(cells <= 0.0)
    at_sheets = int(np.count_nonzero(sheets.touch(grid.centres(folded + 0.5))))
    corners = (folded[:, None] + np.array(list(itertools.product((0, 1), repeat=3)))).reshape(-1, 3)
    in_brain = (owner[tuple(corners.T)] >= 0).reshape(-1, 8)
    jacobian_brain = float(np.nanmin(ratio))
    away = len(folded) - at_sheets
    warnings = []
    if folded_elements:
        warnings.append(
            f"the estimated shift turns {folded_elements} of the mesh's {len(ratio)} elements inside out "
            f"(smallest Jacobian {jacobian_brain:.2f}): the image is wrong there"
        )
    if away and not folded_elements:
        warnings.append(f"the map folds between voxels in {away} places away from the septa; a finer grid would not")
    return MapChecks(
        largest_shift=float(np.linalg.norm(deformation.field.displacement, axis=1).max(initial=0.0)),
        jacobian_brain=jacobian_brain,
        folded_elements=folded_elements,
        jacobian_around=float(jacobian_of_cells(around.displacement, around.grid).min()),
        jacobian_image=float(cells.min()),
        folded_cells=len(folded),
        folded_cells_at_sheets=at_sheets,
        folded_cells_around=int(np.count_nonzero(~in_brain.any(axis=1))),
        **_inverse_errors(deformation, inverse, grid, owner >= 0, rng),
        **_sampling_errors(deformation, inverse, grid, sheets, rng),
        warnings=tuple(warnings),
    )


class _Sheets:
    """Where the sampled map cannot follow the brain: its deformed boundary, both sides of the septa included."""

    def __init__(self, deformation: Deformation, reach: float) -> None:
        faces, _ = boundary_faces(deformation.field.mesh.elements)
        self._surface = Surface(deformation.deformed_nodes, faces.astype(np.int32))
        self._reach = reach

    def touch(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Points (n, 3) of the present within a voxel's diagonal."""
        if len(points) == 0:
            return np.zeros(0, dtype=bool)
        return np.asarray(closest_points(self._surface, points).distance <= self._reach)


def _inverse_errors(
    deformation: Deformation, inverse: NDArray, grid: Grid, in_brain: NDArray[np.bool_], rng: np.random.Generator
) -> dict[str, Errors]:
    outside = ~in_brain & inverse.any(axis=-1)
    errors = {}
    for name, mask, forward in (
        ("inverse_brain", in_brain, deformation.forward_at),
        ("inverse_around", outside, deformation.surroundings.forward),
    ):
        candidates = np.flatnonzero(mask)
        chosen = np.unravel_index(rng.choice(candidates, min(_SAMPLES, candidates.size), replace=False), grid.shape)
        y, v = grid.centres(np.stack(chosen, axis=1)), inverse[chosen].astype(np.float64)
        errors[name] = Errors.of(v + forward(y + v))
    return errors


def _sampling_errors(
    deformation: Deformation, inverse: NDArray, grid: Grid, sheets: _Sheets, rng: np.random.Generator
) -> dict[str, Errors]:
    """Errors at points that are uniform in the deformed brain, where the exact inverse is known by construction."""
    mesh = deformation.field.mesh
    volume = np.abs(jacobian_of_elements(deformation.field) * mesh.volumes)
    element = rng.choice(len(volume), _SAMPLES, p=np.nan_to_num(volume) / np.nansum(volume))
    barycentric = rng.dirichlet(np.ones(4), _SAMPLES)
    corners = mesh.elements[element]
    now, before = (np.einsum("na,nac->nc", barycentric, at[corners]) for at in (deformation.deformed_nodes, mesh.nodes))
    voxels = grid.to_voxels(now)
    shown = reached(voxels, grid.shape, 0.0)
    error = trilinear(inverse, voxels) - (before - now)
    near = sheets.touch(now)
    return {"sampling_brain": Errors.of(error[shown & ~near]), "sampling_sheets": Errors.of(error[shown & near])}

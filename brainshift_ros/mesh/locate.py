"""Find the tetrahedron that holds a point, and the nearest surface point for points outside the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.mesh.nearest import SurfaceLocator
from brainshift_ros.mesh.tetmesh import TetMesh

#: A point whose smallest barycentric coordinate is above this lies in (or on a face of) the element.
_ON_FACE = -1e-9

#: Pairs of (point, candidate element) tested at once; bounds the memory at about 100 MB.
_PAIRS_AT_ONCE = 1_000_000


@dataclass(frozen=True)
class Located:
    """Where points lie in a mesh.

    Attributes
    ----------
    element
        Shape (n,), element index; -1 where the point is farther from the mesh than the limit.
    barycentric
        Shape (n, 4), coordinates in that element, >= 0, summing to one; of the nearest surface point for points outside.
    distance_m
        Shape (n,), distance from the point to the mesh: 0 inside, infinite where `element` is -1 and nothing was searched.
    inside
        Shape (n,), whether the point itself lies in the mesh.
    """

    element: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    inside: NDArray[np.bool_]

    @property
    def found(self) -> NDArray[np.bool_]:
        """Shape (n,): inside, or outside but within the limit."""
        return self.element >= 0

    def interpolate(self, mesh: TetMesh, nodal: NDArray) -> NDArray[np.float64]:
        """Interpolate nodal values, shape (N, ...), at the points; NaN rows where nothing was found."""
        corners = mesh.elements[np.maximum(self.element, 0)]
        values = np.einsum("na,na...->n...", self.barycentric, nodal[corners])
        values[~self.found] = np.nan
        return values


class PointLocator:
    """Point location in a tetrahedral mesh, by bins of element bounding boxes.

    Elements are found by geometry alone, so a point beside a split septum lands in an element of its own side; a point
    exactly on a shared face gets the element with the larger smallest coordinate, then the lower index.

    Parameters
    ----------
    mesh
        The mesh; elements of no volume never hold a point.
    """

    def __init__(self, mesh: TetMesh) -> None:
        self.mesh = mesh
        corners = mesh.nodes[mesh.elements]
        self._origin = corners[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            self._to_barycentric = _inverse_3x3(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
        self._build_bins(corners.min(axis=1), corners.max(axis=1))
        self._surface: SurfaceLocator | None = None

    def locate(self, points: ArrayLike, max_outside_m: float = 0.0) -> Located:
        """Locate points.

        Parameters
        ----------
        points
            Shape (n, 3), metres, patient frame; a row with a non-finite value is never found.
        max_outside_m
            Points outside the mesh are moved to the nearest surface point if that is at most this far.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        element, barycentric = self._containing(points)
        inside = element >= 0
        distance = np.where(inside, 0.0, np.inf)
        outside = np.flatnonzero(~inside & np.isfinite(points).all(axis=1))
        if outside.size and max_outside_m > 0.0:
            if self._surface is None:
                self._surface = SurfaceLocator(self.mesh)
            owner, nearest, distance[outside] = self._surface.nearest(points[outside])
            near = distance[outside] <= max_outside_m
            rows = outside[near]
            element[rows] = owner[near]
            barycentric[rows] = self._clean(self._coordinates(owner[near], nearest[near]))
        return Located(element, barycentric, distance, inside)

    def _build_bins(self, low: NDArray, high: NDArray) -> None:
        """Sort (bin, element) pairs by bin: `_start[b]:_start[b+1]` are the elements whose boxes touch bin b."""
        self._low = self.mesh.nodes.min(axis=0)
        extent = np.maximum(self.mesh.nodes.max(axis=0) - self._low, 1e-12)
        # Bins about as large as a typical element: a few bins per element, a few tens of elements per bin.
        width = np.maximum(np.median(high - low, axis=0), extent / 256.0)
        self._shape = np.maximum(np.ceil(extent / width).astype(np.int64), 1)
        self._bins_per_m = self._shape / extent
        first, last = self._bin_of(low), self._bin_of(high)
        count = last - first + 1
        per_element = count.prod(axis=1)
        element = np.repeat(np.arange(len(low)), per_element)
        step = np.arange(element.size) - np.repeat(np.cumsum(per_element) - per_element, per_element)
        ny, nz = count[element, 1], count[element, 2]
        offset = np.stack([step // (ny * nz), step // nz % ny, step % nz], axis=1)
        flat = self._flatten(first[element] + offset)
        order = np.argsort(flat, kind="stable")
        self._members = element[order]
        self._start = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=int(self._shape.prod())))])

    def _bin_of(self, points: NDArray) -> NDArray[np.int64]:
        return np.clip(((points - self._low) * self._bins_per_m).astype(np.int64), 0, self._shape - 1)

    def _flatten(self, bins: NDArray[np.int64]) -> NDArray[np.int64]:
        return (bins[:, 0] * self._shape[1] + bins[:, 1]) * self._shape[2] + bins[:, 2]

    def _coordinates(self, element: NDArray, points: NDArray) -> NDArray[np.float64]:
        tail = np.einsum("nab,nb->na", self._to_barycentric[element], points - self._origin[element])
        return np.concatenate([1.0 - tail.sum(axis=1, keepdims=True), tail], axis=1)

    @staticmethod
    def _clean(barycentric: NDArray) -> NDArray[np.float64]:
        """Round-off below zero removed, so that interpolation never leaves the range of the nodal values."""
        clipped = np.maximum(barycentric, 0.0)
        return clipped / clipped.sum(axis=1, keepdims=True)

    def _containing(self, points: NDArray) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        element = np.full(len(points), -1, dtype=np.int64)
        barycentric = np.zeros((len(points), 4))
        margin = 1e-9 * self._shape / self._bins_per_m
        with np.errstate(invalid="ignore"):
            boxed = ((points >= self._low - margin) & (points <= self._low + self._shape / self._bins_per_m + margin)).all(
                axis=1
            )
        rows = np.flatnonzero(boxed)
        bins = self._flatten(self._bin_of(points[rows]))
        candidates = self._start[bins + 1] - self._start[bins]
        chunk = np.cumsum(candidates) // _PAIRS_AT_ONCE
        for part in np.split(np.arange(rows.size), np.flatnonzero(np.diff(chunk)) + 1):
            self._test_candidates(points, rows[part], bins[part], candidates[part], element, barycentric)
        return element, barycentric

    def _test_candidates(
        self, points: NDArray, rows: NDArray, bins: NDArray, count: NDArray, element: NDArray, barycentric: NDArray
    ) -> None:
        """Choose, for each of `rows`, the candidate of its bin with the largest smallest coordinate."""
        row = np.repeat(rows, count)
        step = np.arange(row.size) - np.repeat(np.cumsum(count) - count, count)
        member = self._members[np.repeat(self._start[bins], count) + step]
        coordinates = self._coordinates(member, points[row])
        smallest = coordinates.min(axis=1)
        keep = np.flatnonzero(smallest >= _ON_FACE)  # false for the NaN of flat elements
        keep = keep[np.lexsort((-member[keep], smallest[keep]))]  # the best is written last
        element[row[keep]] = member[keep]
        barycentric[row[keep]] = self._clean(coordinates[keep])


def _inverse_3x3(matrices: NDArray) -> NDArray[np.float64]:
    """Inverses of shape (M, 3, 3) by cofactors; infinite or NaN for singular ones, where a general inverse would raise."""
    a, b, c = matrices[:, :, 0], matrices[:, :, 1], matrices[:, :, 2]
    rows = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    return rows / np.einsum("na,na->n", a, rows[:, 0])[:, None, None]

"""The shift around the brain: it continues the brain's, fades out, and never folds space.

On a grid of its own, the field takes the brain's values inside and its nearest value outside, smoothed and faded to zero.
Then its slope is limited (:func:`limit_slope`), which changes little of it: mostly where the two sides of a fissure move
differently. With that limit the map is one to one whatever the brain does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.raster import draw
from brainshift_ros.image.grid import Grid, trilinear
from brainshift_ros.parallel import threaded

#: No component of the field changes by more than this per metre along an axis of the grid. Trilinear interpolation keeps
#: the bound, so the rows of its gradient sum to at most 0.9: x -> x + u(x) is one to one (u contracts in the maximum norm),
#: and its Jacobian determinant, which is extremal where each entry is, is at least det(I - 0.3 ones) = 0.1.
STEEPEST = 0.3

#: The least Jacobian determinant that a field with that slope can have.
LEAST_JACOBIAN = 1.0 - 3.0 * STEEPEST

#: The field fades to zero over at least this distance from the brain, metres...
LEAST_REACH = 0.03

#: ...and over this multiple of the largest displacement. With 4, and the slope's limit, the border of the grid stays zero.
REACH_PER_SHIFT = 4.0

#: Standard deviation, metres, of the Gaussian that smooths the continued values.
_SMOOTHING = 0.006

#: The iteration for the inverse stops when no component moves by more, metres; it contracts by 0.9 a step or faster.
_CONVERGED = 1e-7
_MAX_ITERATIONS = 300

_POINTS_AT_ONCE = 20_000


class Surroundings:
    """A displacement of all space that continues a brain's; see the module.

    Parameters
    ----------
    field
        Forward displacement of the brain.
    spacing
        Voxel edge of its grid, metres.

    Attributes
    ----------
    grid
        Axis-parallel, cubic voxels; around the brain before and after the shift, as far as the field reaches.
    displacement
        Shape (I, J, K, 3), metres, at the voxels; zero beyond.
    """

    def __init__(self, field: DisplacementField, spacing: float) -> None:
        mesh = field.mesh
        largest = float(np.linalg.norm(field.displacement, axis=1).max(initial=0.0))
        reach = max(LEAST_REACH, REACH_PER_SHIFT * largest)
        both = np.concatenate([mesh.nodes, mesh.nodes + field.displacement])
        self.grid = Grid.around(both, spacing, reach + 2 * spacing)
        drawn = np.full((*self.grid.shape, 3), np.nan, dtype=np.float32)
        draw(mesh.nodes, mesh.elements, field.displacement, self.grid, drawn)
        self.displacement = limit_slope(_continued(drawn, spacing, reach), STEEPEST * spacing)

    def forward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement u at points, shape (n, 3) in and out, metres."""
        return trilinear(self.displacement, self.grid.to_voxels(points)).astype(np.float64)

    def inverse(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement v with ``v = -u(y + v)`` at points y, shape (n, 3) in and out, metres.

        The fixed-point iteration of Christensen and Johnson (2001), which the limit of the slope makes converge.
        """
        parts = np.array_split(points, len(points) // _POINTS_AT_ONCE + 1)
        return np.concatenate(list(threaded(self._inverse, parts)))

    def _inverse(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        voxels, edges = self.grid.to_voxels(points), self.grid.voxel_edges
        v = np.zeros((len(points), 3))
        moving = np.arange(len(points))
        for _ in range(_MAX_ITERATIONS):
            update = -trilinear(self.displacement, voxels[moving] + v[moving] / edges).astype(np.float64)
            still = (np.abs(update - v[moving]) <= _CONVERGED).all(axis=1)
            v[moving] = update
            moving = moving[~still]
            if moving.size == 0:
                break
        return v


def limit_slope(field: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    """Limit the difference of neighbours along each index axis to `step`, for each component of a field (I, J, K, C).

    The mean of the largest such function below the field and the smallest above it (the envelopes by which McShane and
    Whitney extend Lipschitz functions, for the 1-norm). A field within the limit is returned as it is.
    """

    def limited(component: NDArray[np.float32]) -> NDArray[np.float32]:
        return 0.5 * (_below(component, step) - _below(-component, step))

    return np.stack(list(threaded(limited, np.moveaxis(field, -1, 0))), axis=-1)


def _below(values: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    """Largest function below `values` whose neighbours differ by `step` at most: min over y of f(y) + step |x - y|_1."""
    for axis, size in enumerate(values.shape):
        ramp = np.expand_dims(step * np.arange(size, dtype=np.float32), [a for a in range(3) if a != axis])
        from_lower = np.minimum.accumulate(values - ramp, axis=axis) + ramp
        from_upper = np.flip(np.minimum.accumulate(np.flip(values + ramp, axis), axis=axis), axis) - ramp
        values = np.minimum(from_lower, from_upper)
    return values


def _continued(drawn: NDArray[np.float32], spacing: float, reach: float) -> NDArray[np.float32]:
    """Continue a field (I, J, K, 3), NaN outside the brain, to the whole grid."""
    outside = np.isnan(drawn[..., 0])
    if outside.all():  # a mesh smaller than a voxel
        return np.zeros_like(drawn)
    distance, nearest = ndimage.distance_transform_edt(outside, return_indices=True)
    # To the brain's surface rather than to the nearest voxel centre, which lies about half a voxel inside.
    distance = (distance.astype(np.float32) - 0.5) * spacing
    s = np.clip(distance / reach, 0.0, 1.0)
    fade = 1.0 - s * s * (3.0 - 2.0 * s)
    # The nearest value meets the brain without a jump; farther out, where it jumps between the values of opposite sides
    # of a fissure, its smoothed version takes over.
    near = np.exp(-np.square(distance / _SMOOTHING))

    def continued(component: NDArray[np.float32]) -> NDArray[np.float32]:
        filled = component[tuple(nearest)]
        smooth = ndimage.gaussian_filter(filled, _SMOOTHING / spacing, truncate=3.0)
        return np.where(outside, (near * filled + (1.0 - near) * smooth) * fade, filled)

    return np.stack(list(threaded(continued, np.moveaxis(drawn, -1, 0))), axis=-1)

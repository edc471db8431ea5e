"""The transform from the template to a patient: rigid T1 and non-rigid T2 (thesis figures 3 and 19)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.image.grid import Grid, trilinear

#: An inverse is refined until it moves by less: a hundredth of a millimetre is far below any voxel.
TOLERANCE_M = 1e-5
#: The tabulated inverse, a start only, is not worth more.
_TABLE_TOLERANCE_M = 5e-5
_MOST_ITERATIONS = 60
#: x <- x + omega (z - u (x) - x) settles while the eigenvalues of grad u lie between -1, where u folds, and 2 / omega - 1.
_RELAXATION = 0.8


@dataclass(frozen=True)
class TemplateMap:
    """Where the template's points lie in the patient, and back.

    With the template point x (RAS+, metres) the patient's is

        y = T1 (T2 (x)),    T2 (x) = A (x + u (x)),

    T1 rigid, A affine, u a displacement interpolated trilinearly on a grid; beyond the grid its border value holds. All
    of T2 happens in the template's frame. The fields are plain arrays, which a file can keep one by one.

    Attributes
    ----------
    T_patient_template
        T1, shape (4, 4), rigid.
    stretch
        A, shape (4, 4): the size and shear that rigid motion leaves.
    displacement
        u, shape (I, J, K, 3), float32, metres.
    inverse_displacement
        v with x + u (x) = z at x = z + v (z), on the same grid: the start from which the inverse is refined.
    T_template_voxel
        Shape (4, 4), the grid of both.
    """

    T_patient_template: NDArray[np.float64]
    stretch: NDArray[np.float64]
    displacement: NDArray[np.float32]
    inverse_displacement: NDArray[np.float32]
    T_template_voxel: NDArray[np.float64]

    @staticmethod
    def create(
        T_patient_template: NDArray[np.float64],
        T_affine: NDArray[np.float64],
        displacement: NDArray[np.float32],
        T_template_voxel: NDArray[np.float64],
    ) -> TemplateMap:
        """Join T1, the whole affine (rigid part included) and u; the inverse displacement is computed."""
        stretch = invert_rigid(T_patient_template) @ T_affine
        grid = Grid((*displacement.shape[:3],), T_template_voxel)
        z = grid.centres(np.argwhere(np.ones(grid.shape, dtype=bool)))
        x = _inverted(displacement, grid, z, z, _TABLE_TOLERANCE_M)
        inverse = (x - z).astype(np.float32).reshape(displacement.shape)
        return TemplateMap(T_patient_template, stretch, displacement, inverse, T_template_voxel)

    @property
    def grid(self) -> Grid:
        """The grid of the displacements, in the template's frame."""
        i, j, k = self.displacement.shape[:3]
        return Grid((i, j, k), self.T_template_voxel)

    @property
    def T_affine(self) -> NDArray[np.float64]:
        """T1 A, shape (4, 4): all of the map but the displacement."""
        return self.T_patient_template @ self.stretch

    def to_patient(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map template points, shape (n, 3), metres, to the patient."""
        x = np.asarray(points, dtype=np.float64)
        return transform_points(self.T_affine, x + trilinear(self.displacement, self.grid.to_voxels(x)))

    def to_template(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map patient points, shape (n, 3), metres, to the template, to within :data:`TOLERANCE_M` where u does not fold."""
        z = transform_points(np.linalg.inv(self.T_affine), np.asarray(points, dtype=np.float64))
        start = z + trilinear(self.inverse_displacement, self.grid.to_voxels(z))
        return _inverted(self.displacement, self.grid, z, start, TOLERANCE_M)

    def to_template_from_table(self, points: ArrayLike) -> NDArray[np.float64]:
        """Approximate :meth:`to_template` by the tabulated inverse: one look-up a point, good to about a tenth of a voxel."""
        z = transform_points(np.linalg.inv(self.T_affine), np.asarray(points, dtype=np.float64))
        return z + trilinear(self.inverse_displacement, self.grid.to_voxels(z))

    def jacobian_determinant(self) -> NDArray[np.float64]:
        """Volume change of T2, shape (I, J, K): det A det (1 + grad u), by central differences; below zero where it folds."""
        R = self.T_template_voxel[:3, :3]
        u = self.displacement.astype(np.float64)
        by_voxel = np.stack([np.gradient(u, axis=axis) for axis in range(3)], axis=-1)
        F = np.eye(3) + by_voxel @ np.linalg.inv(R)
        return np.linalg.det(F) * float(np.linalg.det(self.stretch[:3, :3]))


def _inverted(
    displacement: NDArray[np.float32],
    grid: Grid,
    z: NDArray[np.float64],
    start: NDArray[np.float64],
    tolerance: float,
) -> NDArray[np.float64]:
    """Solve x + u (x) = z for x, shape (n, 3), by a relaxed fixed-point iteration on the points that still move."""
    x = np.array(start)
    active = np.arange(len(z))
    for _ in range(_MOST_ITERATIONS):
        step = z[active] - trilinear(displacement, grid.to_voxels(x[active])) - x[active]
        x[active] += _RELAXATION * step
        active = active[np.abs(step).max(axis=1, initial=0.0) > tolerance]
        if not len(active):
            break
    return x

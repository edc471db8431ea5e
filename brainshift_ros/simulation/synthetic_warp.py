"""Random smooth diffeomorphisms of the template's head: the truth that a registration must find.

A stationary velocity field v is drawn and integrated for unit time (Arsigny et al. 2006), exp(v), by scaling and
squaring. The flow of a smooth field cannot fold, and its inverse is the flow of -v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.units import m_to_mm, mm_to_m

#: Box of the template frame, mm, in which the velocity is drawn: the head and what may move into it.
BOX_MM = np.array([[-132.0, 132.0], [-168.0, 156.0], [-162.0, 144.0]])

#: Spacing of the velocity's nodes; cubic B-splines between them.
NODE_MM = 6.0

#: Widths of the Gaussians that smooth the velocity's noise, and the share of each: broad shape, and finer form.
SMOOTHNESS_MM, SHARES = (35.0, 16.0), (1.0, 0.35)

_SQUARINGS = 5
_TOLERANCE_MM = 1e-4


@dataclass(frozen=True)
class GridField:
    """A vector field in mm on the nodes of the box, as coefficients of cubic B-splines, shape (3, I, J, K)."""

    coefficients: NDArray[np.float64]

    @classmethod
    def through(cls, values: NDArray[np.float64]) -> GridField:
        """Interpolate node values, shape (3, I, J, K)."""
        return cls(np.stack([ndimage.spline_filter(component, order=3, mode="nearest") for component in values]))

    def __call__(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values at points of shape (n, 3), mm; outside the box those of its nearest face."""
        index = ((points_mm - BOX_MM[:, 0]) / NODE_MM).T
        return np.stack(
            [ndimage.map_coordinates(c, index, order=3, mode="nearest", prefilter=False) for c in self.coefficients], axis=1
        )


@dataclass(frozen=True)
class SyntheticWarp:
    """The true map between template and patient: exp(v), then a rigid pose.

    Attributes
    ----------
    velocity
        v, in mm.
    backward
        Displacement of exp(-v), mm: what fetches the template's voxels.
    T_patient_warped
        The rigid pose, metres.
    mean_mm, max_mm
        Length of the displacement of exp(v), pose left out, over the brain.
    jacobian
        Smallest and largest determinant of the gradient of exp(v) over the brain.
    """

    velocity: GridField
    backward: GridField
    T_patient_warped: NDArray[np.float64]
    mean_mm: float
    max_mm: float
    jacobian: tuple[float, float]

    def to_template(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points of the patient frame, shape (n, 3) in metres, to the template."""
        warped_mm = m_to_mm(transform_points(invert_rigid(self.T_patient_warped), points))
        return mm_to_m(warped_mm + self.backward(warped_mm))

    def to_patient(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points of the template frame, shape (n, 3) in metres, to the patient.

        The inverse of :meth:`to_template`, by the fixed point of y <- y + x - exp(-v)(y), to 1e-4 mm.
        """
        return transform_points(self.T_patient_warped, mm_to_m(inverted(self.backward, m_to_mm(points))))


def random_warp(
    rng: np.random.Generator, brain_mm: NDArray[np.float64], mean_displacement_mm: float, T_patient_warped: NDArray[np.float64]
) -> SyntheticWarp:
    """Draw a diffeomorphism whose displacement over the brain has a given mean length.

    The velocity's rigid part over the brain is taken out first, so none of that mean is a mere change of pose.

    Parameters
    ----------
    rng
        Source of chance.
    brain_mm
        Points of the template's brain, shape (n, 3), mm.
    mean_displacement_mm
        Mean of |exp(v)(x) - x| over `brain_mm`.
    T_patient_warped
        Rigid pose that follows, metres.

    Raises
    ------
    InputError
        So large a displacement that the discrete map folds (some Jacobian <= 0) inside the brain.
    """
    nodes_mm = _nodes_mm()
    unit_velocity = _without_rigid(_noise(rng, nodes_mm.shape[:3]), nodes_mm, brain_mm)
    amplitude = 1.0
    some_mm = brain_mm[:: max(1, len(brain_mm) // 1000)]
    for _ in range(3):  # exp is nearly linear in the amplitude
        velocity = GridField.through(amplitude * unit_velocity)
        reached = float(np.linalg.norm(flow(velocity, some_mm) - some_mm, axis=1).mean())
        amplitude *= mean_displacement_mm / reached
    velocity = GridField.through(amplitude * unit_velocity)
    backward = _exponential(-amplitude * unit_velocity, nodes_mm)
    moved_mm = inverted(backward, brain_mm)
    length = np.linalg.norm(moved_mm - brain_mm, axis=1)
    jacobian = 1.0 / jacobian_determinant(backward, moved_mm)
    if jacobian.min() <= 0.0 or np.abs(moved_mm + backward(moved_mm) - brain_mm).max() > _TOLERANCE_MM:
        problem = f"a mean of {mean_displacement_mm:g} mm folds the brain"
        raise InputError("mean_displacement_mm", problem, "ask for less")
    bounds = float(jacobian.min()), float(jacobian.max())
    return SyntheticWarp(velocity, backward, T_patient_warped, float(length.mean()), float(length.max()), bounds)


def inverted(displacement: GridField, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points y with y + u(y) = x, for x of shape (n, 3), by fixed-point iteration (Christensen and Johnson 2001)."""
    found_mm = points_mm - displacement(points_mm)
    for _ in range(100):
        miss_mm = points_mm - found_mm - displacement(found_mm)
        found_mm = found_mm + miss_mm
        if np.abs(miss_mm).max(initial=0.0) < 0.1 * _TOLERANCE_MM:
            break
    return found_mm


def flow(velocity: GridField, points_mm: NDArray[np.float64], steps: int = 4) -> NDArray[np.float64]:
    """Carry points along a stationary velocity for unit time (classical Runge-Kutta)."""
    x, h = points_mm, 1.0 / steps
    for _ in range(steps):
        k1 = velocity(x)
        k2 = velocity(x + 0.5 * h * k1)
        k3 = velocity(x + 0.5 * h * k2)
        k4 = velocity(x + h * k3)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x


def jacobian_determinant(displacement: GridField, points_mm: NDArray[np.float64], step_mm: float = 0.5) -> NDArray[np.float64]:
    """Take the determinant of the gradient of x + u(x) at points (n, 3), by central differences of the spline."""
    columns = [
        (displacement(points_mm + step) - displacement(points_mm - step)) / (2.0 * step_mm) for step in step_mm * np.eye(3)
    ]
    return np.linalg.det(np.eye(3) + np.stack(columns, axis=-1))


def _exponential(velocity: NDArray[np.float64], nodes_mm: NDArray[np.float64]) -> GridField:
    """Displacement of exp(v) by scaling and squaring: exp(v) = exp(v / 2^n) composed with itself n times."""
    x = nodes_mm.reshape(-1, 3)
    step = GridField.through(velocity / 2.0**_SQUARINGS)
    # The first step by the midpoint rule: with Euler's, it would take many more squarings.
    displacement = np.moveaxis(step(x + 0.5 * step(x)).reshape(nodes_mm.shape), -1, 0)
    for _ in range(_SQUARINGS):
        u = np.moveaxis(displacement, 0, -1).reshape(-1, 3)
        composed = u + GridField.through(displacement)(x + u)
        displacement = np.moveaxis(composed.reshape(nodes_mm.shape), -1, 0)
    return GridField.through(displacement)


def _nodes_mm() -> NDArray[np.float64]:
    axes = [np.arange(low, high + 0.5 * NODE_MM, NODE_MM) for low, high in BOX_MM]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _noise(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Smooth noise of shape (3, I, J, K): white noise blurred by Gaussians of several widths, each of unit variance."""
    total = np.zeros((3, *shape))
    for width_mm, share in zip(SMOOTHNESS_MM, SHARES, strict=True):
        smooth = np.stack(
            [ndimage.gaussian_filter(rng.normal(size=shape), width_mm / NODE_MM, mode="nearest") for _ in range(3)]
        )
        total += share * smooth / smooth.std()
    return total


def _without_rigid(
    velocity: NDArray[np.float64], nodes_mm: NDArray[np.float64], brain_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Subtract the rigid velocity a + b x (x - c) that fits best over the brain."""
    centre = brain_mm.mean(axis=0)
    basis = _rigid_basis(brain_mm - centre)
    target = GridField.through(velocity)(brain_mm).ravel()
    rigid, *_ = np.linalg.lstsq(basis.reshape(-1, 6), target, rcond=None)
    everywhere = _rigid_basis(nodes_mm.reshape(-1, 3) - centre) @ rigid
    return velocity - np.moveaxis(everywhere.reshape(nodes_mm.shape), -1, 0)


def _rigid_basis(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Velocities (n, 3, 6) of unit translations and unit rotations at offsets (n, 3)."""
    turns = np.stack([np.cross(axis, offset) for axis in np.eye(3)], axis=-1)
    return np.concatenate([np.broadcast_to(np.eye(3), (len(offset), 3, 3)), turns], axis=-1)

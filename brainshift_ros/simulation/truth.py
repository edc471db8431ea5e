"""A simulated truth: what the brain really does, on a mesh and with properties that the atlas has never seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.geometry import unit
from brainshift_ros.mechanics.forward import ForwardSolution, solve_gravity
from brainshift_ros.mechanics.materials import Material, material_of
from brainshift_ros.mechanics.skull import SkullName
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.tetmesh import TetMesh

#: Points of a fine surface may stick out of a coarse mesh by this much and still move with it.
_SURFACE_TOLERANCE_M = 15e-3

#: Correlation length of the stiffness of a truth, metres.
STIFFNESS_LENGTH_M = 0.03


@dataclass(frozen=True)
class Truth:
    """A forward solution that can be asked anywhere.

    Attributes
    ----------
    mesh
        The truth's own mesh.
    solution
        Displacement at its nodes.
    material
        The perturbed properties of its elements.
    gravity_direction
        Unit vector, patient frame.
    fluid_level
        See :class:`brainshift_ros.atlas.entry.AtlasEntry`.
    """

    mesh: TetMesh
    solution: ForwardSolution
    material: Material
    gravity_direction: NDArray[np.float64]
    fluid_level: float

    def displacement_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement at points, both of shape (n, 3), metres, patient frame; beside the mesh that of its nearest surface.

        Raises
        ------
        ValueError
            A point is farther than 15 mm from the mesh.
        """
        located = PointLocator(self.mesh).locate(points, max_outside_m=_SURFACE_TOLERANCE_M)
        if not located.found.all():
            raise ValueError(f"{int((~located.found).sum())} points are not on the truth's mesh")
        return located.interpolate(self.mesh, self.solution.displacement)


def direction_between(directions: ArrayLike, axis: ArrayLike, half_angle: float) -> NDArray[np.float64]:
    """Find the direction in a cone that is farthest from all given ones, hence hardest to interpolate.

    Parameters
    ----------
    directions
        Shape (n, 3), unit vectors.
    axis, half_angle
        The cone, `half_angle` in radians.
    """
    candidates = directions_in_cone(axis, 0.8 * half_angle, 4000)
    nearest = (candidates @ np.asarray(directions).T).max(axis=1)
    return candidates[np.argmin(nearest)]


def smooth_random_field(
    points: NDArray[np.float64], length_m: float, rng: np.random.Generator, modes: int = 64
) -> NDArray[np.float64]:
    """Zero-mean, unit-variance Gaussian random field at points, shape (n, 3), with a squared-exponential correlation.

    Random Fourier features (Rahimi and Recht 2007): a sum of cosines whose wave vectors are drawn from the kernel's spectrum.
    """
    waves = rng.normal(scale=1.0 / length_m, size=(modes, 3))
    phases = rng.uniform(0.0, 2.0 * np.pi, modes)
    return np.sqrt(2.0 / modes) * np.cos(points @ waves.T + phases).sum(axis=1)


def varied_material(patient: PatientModel, seed: int, spread: float, length_m: float = STIFFNESS_LENGTH_M) -> Material:
    """Properties of table 1 with a Young's modulus that varies through the tissue as a log-normal random field.

    Parameters
    ----------
    patient
        Mesh and tissue.
    seed
        Decides the field.
    spread
        Standard deviation of the logarithm of Young's modulus about table 1's values.
    length_m
        Correlation length, metres.
    """
    centroids = patient.mesh.nodes[patient.mesh.elements].mean(axis=1)
    variation = smooth_random_field(centroids, length_m, np.random.default_rng(seed))
    nominal = material_of(patient.tissue)
    return replace(nominal, youngs_modulus=nominal.youngs_modulus * np.exp(spread * variation))


def simulate_truth(
    patient: PatientModel,
    gravity_direction: ArrayLike,
    fluid_level: float,
    *,
    seed: int,
    resected: bool = False,
    skull: SkullName = "free_cap",
    opening: NDArray[np.bool_] | None = None,
    stiffness_spread: float = 0.25,
    stiffness_length_m: float = STIFFNESS_LENGTH_M,
) -> Truth:
    """Solve the forward model with a stiffness that varies through the tissue.

    Parameters
    ----------
    patient
        The head, on a mesh that is not the atlas's.
    gravity_direction, fluid_level, resected, skull, opening
        As in :func:`brainshift_ros.mechanics.forward.solve_gravity`.
    seed
        Decides the stiffness field.
    stiffness_spread
        Standard deviation of the logarithm of Young's modulus about table 1's values.
    stiffness_length_m
        Correlation length of the stiffness, metres.
    """
    material = varied_material(patient, seed, stiffness_spread, stiffness_length_m)
    direction = unit(gravity_direction)
    solution = solve_gravity(patient.mesh, material, direction, fluid_level, resected=resected, skull=skull, opening=opening)
    return Truth(patient.mesh, solution, material, direction, fluid_level)

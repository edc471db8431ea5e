"""Parts of :mod:`brainshift_ros.experiments.skull`: the models compared, truths at finite strain, atlases in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.atlas.columns import groups_of
from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.patients import craniotomy_opening, study_groups
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.mechanics.boundary import CAP_LEVEL
from brainshift_ros.mechanics.cases import Case
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.skull import SkullName
from brainshift_ros.mechanics.steady import SteadyModel
from brainshift_ros.mechanics.system import System, assemble_system
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.simulation.finite_strain import FiniteStrainSolution, solve_finite_strain

#: Fluid of the truths, as a fraction of the head's extent along up: the uppermost cortex sags by 8 to 15 mm.
FLUID_LEVEL = 0.5


@dataclass(frozen=True)
class Skull:
    """A model of the skull: its name, and above which level tissue is not held to it."""

    model: SkullName
    cap_level: float


#: What is compared. The thesis sets the cap's level by hand; the fluid's level is the physical one, where air comes in.
SKULLS: Mapping[str, Skull] = {
    "free, high cap": Skull("free_cap", CAP_LEVEL),
    "free to the fluid": Skull("free_cap", FLUID_LEVEL),
    "contact, high cap": Skull("contact", CAP_LEVEL),
    "contact to the fluid": Skull("contact", FLUID_LEVEL),
}


@dataclass(frozen=True)
class TruthCase:
    """What a finite-strain truth is made of.

    Attributes
    ----------
    orientation
        Its name.
    direction
        Of gravity, patient frame.
    cap_level
        Above it tissue may leave the skull.
    resected
        Whether the tumour is out.
    """

    orientation: str
    direction: tuple[float, float, float]
    cap_level: float
    resected: bool


class Truths:
    """Finite-strain truths, and linear solutions with the same loads, on one quadratic mesh.

    Parameters
    ----------
    patient
        The truth's mesh.
    """

    def __init__(self, patient: PatientModel) -> None:
        self.mesh = patient.mesh
        self._material = material_of(patient.tissue)
        self._systems: dict[bool, System] = {}
        self.opening = craniotomy_opening(self.mesh)
        self._groups = study_groups(self.mesh)

    def solve(self, case: TruthCase) -> FiniteStrainSolution:
        """Solve a truth."""
        system = self._system(case.resected)
        return solve_finite_strain(system, case.direction, FLUID_LEVEL, cap_level=case.cap_level, opening=self.opening)

    def linear(self, case: TruthCase, skull: Skull) -> NDArray[np.float64]:
        """Displacement (N, 3), m, of small-strain theory under the same load."""
        system, cap_level = self._system(case.resected), skull.cap_level
        model = SteadyModel(system, [case.direction], skull=skull.model, opening=self.opening, cap_level=cap_level)
        return next(model.solve([Case("gravity", case.direction, FLUID_LEVEL)])).displacement[:, :, 0]

    def groups(self, case: TruthCase) -> dict[str, NDArray[np.intp]]:
        """Target nodes by group; only those that still carry tissue."""
        solved = self._system(case.resected).submesh.node_of >= 0
        return {name: ids[solved[ids]] for name, ids in self._groups.items() if solved[ids].any()}

    def measured(
        self, case: TruthCase, displacement: NDArray[np.float64], count: int, noise_m: float, rng: np.random.Generator
    ) -> HomologousPoints:
        """Measure random points of the cortex in the opening, with a standard deviation `noise_m` along each axis."""
        skull = self.mesh.facets["skull"]
        solved = self._system(case.resected).submesh.node_of >= 0
        facets = skull[(self.opening & solved)[skull].all(axis=1)]
        corners = self.mesh.nodes[facets]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        chosen = facets[rng.choice(len(facets), count, p=area / area.sum())]
        weights = rng.dirichlet(np.ones(3), count)
        points, moved = (np.einsum("na,nai->ni", weights, values[chosen]) for values in (self.mesh.nodes, displacement))
        return HomologousPoints(points, moved + rng.normal(0.0, noise_m, moved.shape), np.full(count, noise_m))

    def _system(self, resected: bool) -> System:
        if resected not in self._systems:
            self._systems[resected] = assemble_system(self.mesh, self._material, resected=resected, element="P2")
        return self._systems[resected]


@dataclass(frozen=True)
class MemoryAtlas:
    """An atlas that is not on disk; see :class:`brainshift_ros.inverse.atlas_like.AtlasLike`."""

    mesh: TetMesh
    E: NDArray[np.float32]
    entries: tuple[AtlasEntry, ...]
    groups: tuple[WeightGroup, ...]
    path: Path = Path("memory")
    atlas_id: str = ""
    patient_id: str = ""

    def rows(self, node_ids: ArrayLike) -> NDArray[np.float32]:
        """Displacements of some nodes in all entries, (n, 3, m)."""
        return self.E[np.asarray(node_ids)]

    def columns(self, ids: ArrayLike) -> NDArray[np.float32]:
        """Displacements of all nodes in some entries, (N, 3, k)."""
        return self.E[:, :, np.asarray(ids)]


def build_memory_atlas(
    systems: Mapping[bool, System],
    planned: ArrayLike,
    half_angle: float,
    orientations: int,
    fluid_levels: Sequence[float],
    skull: Skull,
) -> tuple[MemoryAtlas, Stopwatch]:
    """Solve gravity for a cone of orientations, without and with resection.

    Parameters
    ----------
    systems
        Of the atlas's mesh, by whether the tumour is out.
    planned, half_angle, orientations
        The cone, `half_angle` in radians.
    fluid_levels
        Of the entries.
    skull
        The model of the skull.

    Returns
    -------
    The atlas, and what solving it took.
    """
    cone = directions_in_cone(planned, half_angle, orientations)
    directions = [(float(x), float(y), float(z)) for x, y, z in cone]
    head = next(iter(systems.values())).head
    opening = craniotomy_opening(head)
    entries: list[AtlasEntry] = []
    parts = []
    with Stopwatch() as watch:
        for resected, system in systems.items():
            model = SteadyModel(system, directions, skull=skull.model, opening=opening, cap_level=skull.cap_level)
            cases = [Case("gravity", direction, level) for direction in directions for level in fluid_levels]
            part = np.empty((len(head.nodes), 3, len(cases)), dtype=np.float32)
            for block in model.solve(cases):
                part[:, :, block.cases] = block.displacement
            parts.append(part)
            entries += [AtlasEntry("gravity", case.gravity_direction, case.fluid_level, 0, resected) for case in cases]
    E = np.concatenate(parts, axis=2)
    return MemoryAtlas(head, E, tuple(entries), groups_of(tuple(entries))), watch

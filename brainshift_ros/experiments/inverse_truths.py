"""Truths that the studies of the inverse model share: what a brain did that the atlas has never seen.

A truth differs from every column of an atlas in its mesh, its orientation (anywhere in the cone, between the atlas's), its
fluid level, a stiffness that varies through the tissue, and its size. Drug and gravity act in it together, so under one-sided
skull contact it is no sum of columns either. What most share with the atlas is linear theory, and all the shape of the head:
a few are solved at finite strain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from json import dumps
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from brainshift_ros.atlas.columns import SUBMERGED
from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.experiments.patients import craniotomy_opening, template_patient
from brainshift_ros.files import atomic_path
from brainshift_ros.geometry import tangent_frame, unit
from brainshift_ros.h5 import digest
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.cases import Capillaries, Case
from brainshift_ros.mechanics.skull import SkullName, skull_constraints
from brainshift_ros.mechanics.system import System, assemble_system
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.simulation.finite_strain import solve_finite_strain
from brainshift_ros.simulation.truth import varied_material
from brainshift_ros.solvers.many import ManySolver
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]
Direction = tuple[float, float, float]

#: Along which gravity was planned to pull: supine, head a little raised. Cone of the atlases around it, degrees.
PLANNED: Direction = (0.0, -0.94, -0.34)
CONE_DEG = 20.0

#: Mean shift of the cortex under the craniotomy, mm: the range of the thesis's patients (table 3) without the largest.
SURFACE_SHIFT_MM = (4.0, 20.0)

#: Distance from the tumour's centre at which a collapsing cavity moves most.
COLLAPSE_REACH_M = 0.02

#: Shares of the drug's steady field that the study `mannitol` saw after 10 minutes (k_c1) to 40 minutes (k_c3).
_MANNITOL = (0.1, 0.5)

#: Fluid levels of truths: within the atlas's range of 0.4 to 0.8, and a little below it.
_FLUID_LEVELS = (0.35, 0.75)


@dataclass(frozen=True)
class TruthSpec:
    """What a truth is made of.

    Attributes
    ----------
    seed
        Decides the stiffness field.
    direction
        Unit vector along which gravity pulls, patient frame.
    fluid_level
        See :class:`brainshift_ros.atlas.entry.AtlasEntry`.
    resected
        Whether the tumour is out.
    mannitol
        Share of the drug's steady load that acts beside gravity, 0 to 1; it stands for the time since the drug was given.
    permeability
        Where between k_c1 and k_c3 the drug puts the capillary permeability, 0 to 1.
    skull
        ``contact`` or ``free_cap``.
    surface_shift_mm
        Mean shift of the cortex under the craniotomy in linear theory, by a brain that is softer or stiffer as a whole (skull
        contact scales with it). None leaves table 1's stiffness.
    stiffness_spread
        Standard deviation of the logarithm of Young's modulus within the brain.
    finite_strain
        Whether the brain is a neo-Hookean solid in a rigid skull rather than linear. Only gravity acts on it.
    """

    seed: int
    direction: Direction
    fluid_level: float
    resected: bool = False
    mannitol: float = 0.0
    permeability: float = 0.0
    skull: SkullName = "contact"
    surface_shift_mm: float | None = None
    stiffness_spread: float = 0.25
    finite_strain: bool = False


@dataclass(frozen=True)
class InverseTruth:
    """A truth on its own mesh.

    Attributes
    ----------
    spec
        What it is made of.
    mesh
        Its mesh, N nodes.
    displacement
        Shape (N, 3), m, patient frame.
    tissue
        Shape (N,), nodes that still carry tissue.
    """

    spec: TruthSpec
    mesh: TetMesh
    displacement: NDArray[np.float64]
    tissue: NDArray[np.bool_]


def drawn_truth(seed: int, skull: SkullName = "contact", cone_deg: float = CONE_DEG) -> TruthSpec:
    """Draw a truth: every second is resected, every second pair has mannitol; the rest is random.

    Parameters
    ----------
    seed
        Decides everything, the stiffness field included.
    skull
        See :class:`TruthSpec`.
    cone_deg
        Half angle of the cone around :data:`PLANNED` that its orientation is drawn from, evenly by area.
    """
    rng = np.random.default_rng([seed, 39])
    angle = float(np.arccos(rng.uniform(np.cos(np.radians(cone_deg)), 1.0)))
    direction = tilted(PLANNED, angle, float(rng.uniform(0.0, 2.0 * np.pi)))
    fluid_level, shift_mm = float(rng.uniform(*_FLUID_LEVELS)), float(rng.uniform(*SURFACE_SHIFT_MM))
    mannitol, permeability = float(rng.uniform(*_MANNITOL)), float(rng.uniform(0.0, 1.0))
    with_drug = seed // 2 % 2 == 1
    return TruthSpec(
        seed=seed,
        direction=direction,
        fluid_level=fluid_level,
        resected=seed % 2 == 1,
        mannitol=mannitol if with_drug else 0.0,
        permeability=permeability if with_drug else 0.0,
        skull=skull,
        surface_shift_mm=shift_mm,
    )


def tilted(axis: Direction, angle: float, azimuth: float) -> Direction:
    """Turn an axis by an angle towards an azimuth around it, both radians."""
    first, second, third = tangent_frame(axis)
    x, y, z = unit(np.cos(angle) * third + np.sin(angle) * (np.cos(azimuth) * first + np.sin(azimuth) * second))
    return float(x), float(y), float(z)


def collapsed(truth: InverseTruth, depth_m: float, reach_m: float = COLLAPSE_REACH_M) -> InverseTruth:
    """Let the cavity's wall fall inwards, which no column does: the mechanism that chapter IV of the thesis misses.

    Added is ``-depth x/reach exp((1 - |x|^2/reach^2) / 2)``, x from the tumour's centre: largest, `depth`, at `reach`.

    Parameters
    ----------
    truth
        Of a head with a tumour.
    depth_m, reach_m
        Largest displacement, and the distance from the tumour's centre at which it is; metres.
    """
    tumor = truth.mesh.elements[truth.mesh.region == Region.TUMOR]
    x = (truth.mesh.nodes - truth.mesh.nodes[np.unique(tumor)].mean(axis=0)) / reach_m
    inwards = -depth_m * x * np.exp(0.5 * (1.0 - np.sum(x**2, axis=1, keepdims=True)))
    return replace(truth, displacement=truth.displacement + inwards)


def degrees_to_nearest(direction: Direction, orientations: int, cone_deg: float = CONE_DEG) -> float:
    """Angle from a direction to the nearest of an atlas's orientations, degrees."""
    columns = directions_in_cone(PLANNED, np.radians(cone_deg), orientations)
    return float(np.degrees(np.arccos(np.clip((columns @ np.asarray(direction)).max(), -1.0, 1.0))))


def truth_patients(folder: Path, nodes: int, progress: Progress, seeds: Iterable[int] = (1,)) -> tuple[PatientModel, ...]:
    """Other meshes of the head that the atlases of seed 0 are built on; see :func:`.patients.template_patient`."""
    return tuple(template_patient(folder, nodes, seed, progress) for seed in seeds)


def solve_truth(patient: PatientModel, spec: TruthSpec) -> InverseTruth:
    """Solve gravity and drug acting together, with a stiffness that varies.

    Raises
    ------
    ArithmeticError
        A residual is too large.
    NoEquilibriumError
        No equilibrium at finite strain was found: the brain is too soft for its weight.
    ValueError
        A finite-strain truth is asked for with a drug or a free cap.
    """
    if spec.finite_strain and (spec.mannitol > 0.0 or spec.skull != "contact"):
        raise ValueError("a finite-strain truth is made of gravity and skull contact alone")
    material = varied_material(patient, spec.seed, spec.stiffness_spread)
    system = assemble_system(patient.mesh, material, resected=spec.resected)
    opening, tissue = craniotomy_opening(patient.mesh), system.submesh.node_of >= 0
    displacement = _linear(system, spec, opening)
    softer = 1.0
    if spec.surface_shift_mm is not None:
        shift = np.linalg.norm(displacement[opening & tissue], axis=1).mean()
        softer = float(mm_to_m(spec.surface_shift_mm) / shift)
    if not spec.finite_strain:
        return InverseTruth(spec, patient.mesh, softer * displacement, tissue)
    soft = replace(material, youngs_modulus=material.youngs_modulus / softer)
    system = assemble_system(patient.mesh, soft, resected=spec.resected)
    solved = solve_finite_strain(system, spec.direction, spec.fluid_level, opening=opening)
    return InverseTruth(spec, patient.mesh, solved.displacement, tissue)


def solved_truths(
    folder: Path, patients: Iterable[PatientModel], specs: Iterable[TruthSpec], progress: Progress
) -> Iterator[InverseTruth]:
    """Truths of :func:`solved_truth`, by turns on each of some meshes.

    Parameters
    ----------
    folder
        Keeps a file for each.
    patients
        Meshes.
    specs
        What to solve.
    progress
        Called with stage and fraction done.
    """
    meshes, wanted = list(patients), list(specs)
    for number, spec in enumerate(wanted):
        progress("truths", number / len(wanted))
        yield solved_truth(folder, meshes[number % len(meshes)], spec)
    progress("truths", 1.0)


def solved_truth(folder: Path, patient: PatientModel, spec: TruthSpec) -> InverseTruth:
    """:func:`solve_truth`, once: a later call reads what an earlier one left in `folder`."""
    path = folder / f"truth_{digest(patient.patient_id, dumps(asdict(spec)))[:16]}.npz"
    if path.is_file():
        with np.load(path) as kept:
            return InverseTruth(spec, patient.mesh, kept["displacement"], kept["tissue"])
    truth = solve_truth(patient, spec)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, displacement=truth.displacement, tissue=truth.tissue)
    return truth


def _linear(system: System, spec: TruthSpec, opening: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Displacement (N, 3), m, at small strain."""
    load = system.gravity(spec.direction, spec.fluid_level)
    if spec.mannitol > 0.0:
        load = load + spec.mannitol * _drug_load(system, spec)
    held, one_sided = skull_constraints(system, [spec.direction], spec.skull, opening)
    return system.displacement(_solved(system.stiffness, held, one_sided, load))[:, :, 0]


def _drug_load(system: System, spec: TruthSpec) -> NDArray[np.float64]:
    """Load (3n,), N, of the drug's steady pressure."""
    case = Case("mannitol", spec.direction, SUBMERGED, spec.permeability)
    capillaries, fluid = Capillaries(system), system.fluid
    exchange = capillaries.exchange(case)
    drained = system.stress_free(spec.direction)[None]
    source = fluid.source(exchange, capillaries.pressure(case))
    return system.pressure_load(_solved(fluid.helmholtz(exchange), drained, None, source))[:, 0]


def _solved(
    matrix: sp.csr_matrix, held: NDArray[np.bool_], one_sided: NDArray[np.bool_] | None, load: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solution (n, 1) for one load (n,)."""
    return ManySolver(matrix, held, one_sided).solve_block(load[:, None], np.zeros(1, dtype=np.int64)).solution

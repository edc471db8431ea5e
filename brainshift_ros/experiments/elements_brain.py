"""Linear against quadratic elements on the brain with tumour and septa, part of :mod:`brainshift_ros.experiments.elements`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.experiments.patients import craniotomy_opening, study_groups
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.mechanics.cases import Case
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.space import ElementName
from brainshift_ros.mechanics.steady import SteadyModel
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.units import m_to_mm

#: Supine with a left frontal craniotomy, as in the example scene, and the cone around it.
PLANNED, CONE = (0.0, -0.94, -0.34), np.radians(20.0)
FLUID_LEVEL = 0.4
MECHANISMS = ("gravity", "mannitol")

#: The first directions' fields are compared: the planned one, and one on the cone's rim.
COMPARED = 2

#: One mesh's surface lies beside another's by up to this, metres.
_BESIDE_M = 0.01


@dataclass(frozen=True)
class BrainSolution:
    """Fields of one mesh and element, and what they took.

    Attributes
    ----------
    mesh
        Their mesh; values at its vertices are what an atlas keeps.
    fields
        By mechanism, shape (N, 3, c), m, for the compared directions.
    row
        Vertices, dofs and CPU times: `factorise_s` includes assembly, `entry_s` is the mean of one more entry.
    """

    mesh: TetMesh
    fields: Mapping[str, NDArray[np.float64]]
    row: Mapping[str, Any]


def directions_of(count: int) -> list[tuple[float, float, float]]:
    """Directions of gravity in the cone, those that are compared first."""
    cone = directions_in_cone(PLANNED, CONE, count)
    ordered = [cone[0], *cone[:0:-1]]
    return [(float(x), float(y), float(z)) for x, y, z in ordered]


def solve_brain(patient: PatientModel, element: ElementName, directions: Sequence[tuple[float, float, float]]) -> BrainSolution:
    """Solve gravity with contact and mannitol for some orientations.

    Parameters
    ----------
    patient
        Its mesh and tissue.
    element
        ``P1`` or ``P2``.
    directions
        Of gravity; the first are compared, and all make the mean time of an entry.
    """
    row: dict[str, Any] = {"element": element, "vertices": len(patient.mesh.nodes)}
    with Stopwatch() as watch:
        system = assemble_system(patient.mesh, material_of(patient.tissue), element=element)
        model = SteadyModel(system, directions, skull="contact", opening=craniotomy_opening(patient.mesh))
    row |= {"dofs": 3 * len(system.space), "factorise_s": watch.cpu_s}
    fields = {}
    for mechanism in MECHANISMS:
        cases = [Case(mechanism, direction, FLUID_LEVEL) for direction in directions]
        solved = np.empty((len(patient.mesh.nodes), 3, len(cases)))
        with Stopwatch() as watch:
            for block in model.solve(cases):
                solved[:, :, block.cases] = block.displacement
        row[f"{mechanism}_entry_s"] = watch.cpu_s / len(cases)
        fields[mechanism] = solved[:, :, :COMPARED]
    return BrainSolution(patient.mesh, fields, row)


def compared(solution: BrainSolution, reference: BrainSolution) -> list[dict[str, Any]]:
    """Mean differences from a reference at its target nodes, a row for each mechanism and group of targets.

    Both fields are what an atlas keeps, values at vertices; the one compared is interpolated linearly.
    """
    locator = PointLocator(solution.mesh)
    rows = []
    for group, ids in study_groups(reference.mesh).items():
        located = locator.locate(reference.mesh.nodes[ids], _BESIDE_M)
        for mechanism in MECHANISMS:
            expected = reference.fields[mechanism][ids[located.found]]
            found = located.interpolate(solution.mesh, solution.fields[mechanism])[located.found]
            error_mm = m_to_mm(np.linalg.norm(found - expected, axis=1))
            rows.append(
                {
                    **solution.row,
                    "mechanism": mechanism,
                    "group": group,
                    "targets": len(expected),
                    "shift_mm_mean": float(m_to_mm(np.linalg.norm(expected, axis=1)).mean()),
                    "error_mm_mean": float(error_mm.mean()),
                    "error_mm_p95": float(np.percentile(error_mm, 95.0)),
                }
            )
    return rows

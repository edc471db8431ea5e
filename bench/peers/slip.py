"""A slip problem that NGSolve can pose too: a bar whose walls are coordinate planes, so that slip holds single components.

Its inner nodes are moved at random, its stiffness and its weight differ from element to element. ``python -m bench.peers.slip``
asks NGSolve and writes what it answers to ``test/data/ngsolve_slip.npz``; a test compares the package with that file, and
`make bench` with NGSolve itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from skfem import MeshTet

from bench.measure import timed
from bench.peers.client import PeerAnswer, ask
from brainshift_ros.files import atomic_path
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.elasticity import lame_parameters
from brainshift_ros.mechanics.forward import solve_system
from brainshift_ros.mechanics.materials import GRAVITY, Material
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.surface.facets import LOCAL_FACES

STORED = Path(__file__).resolve().parents[2] / "test" / "data" / "ngsolve_slip.npz"

DOWN = (0.0, 0.0, -1.0)
_SIZE_M, _CELLS = (0.06, 0.06, 0.1), (4, 4, 6)

#: Boundaries and the components that each holds.
_HELD = {"base": (1, 1, 1), "x": (1, 0, 0), "y": (0, 1, 0), "top": (0, 0, 0)}


@dataclass(frozen=True)
class SlipProblem:
    """The bar: base fixed, sides slip (as a falx and a tentorium), top free."""

    mesh: TetMesh
    material: Material
    boundaries: dict[str, NDArray[np.int32]]


def slip_problem() -> SlipProblem:
    """Make the bar; always the same."""
    rng = np.random.default_rng(0)
    grid = MeshTet.init_tensor(*(np.linspace(0.0, size, count + 1) for size, count in zip(_SIZE_M, _CELLS, strict=True)))
    nodes, elements = np.ascontiguousarray(grid.p.T), np.array(grid.t.T, dtype=np.int32)
    size = np.array(_SIZE_M)
    inner = np.all((nodes > 1e-9) & (nodes < size - 1e-9), axis=1)
    nodes[inner] += rng.uniform(-0.2, 0.2, (int(inner.sum()), 3)) * size / _CELLS
    corners = nodes[elements]
    mirrored = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    elements[mirrored] = elements[mirrored][:, [0, 2, 1, 3]]
    faces = elements[:, LOCAL_FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[first[count == 1]].astype(np.int32)
    at = nodes[outer]
    on = {
        "base": np.isclose(at[..., 2], 0.0).all(axis=1),
        "x": np.isclose(at[..., 0], 0.0).all(axis=1) | np.isclose(at[..., 0], size[0]).all(axis=1),
        "y": np.isclose(at[..., 1], 0.0).all(axis=1) | np.isclose(at[..., 1], size[1]).all(axis=1),
        "top": np.isclose(at[..., 2], size[2]).all(axis=1),
    }
    boundaries = {name: outer[mask] for name, mask in on.items()}
    number = len(elements)
    material = Material(
        youngs_modulus=2100.0 * np.exp(rng.normal(size=number)),
        poissons_ratio=np.full(number, 0.45),
        density=1000.0 * rng.uniform(0.5, 1.5, number),
    )
    facets = {"falx": boundaries["x"], "tentorium": boundaries["y"], "skull": boundaries["top"]}
    base = np.flatnonzero(np.isclose(nodes[:, 2], 0.0)).astype(np.int32)
    region = np.full(number, Region.LEFT_CEREBRUM, np.uint8)
    return SlipProblem(TetMesh(nodes, elements, region, facets, {"brainstem": base}), material, boundaries)


def solve_by_ngsolve(problem: SlipProblem, order: int) -> PeerAnswer:
    """Let NGSolve solve it with elements of an order; its solution is the displacement of the mesh's nodes, (N, 3), m."""
    material = problem.material
    lam, mu = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    names = list(problem.boundaries)
    return ask(
        nodes=problem.mesh.nodes,
        elements=problem.mesh.elements,
        facets=np.concatenate([problem.boundaries[name] for name in names]),
        names=np.array(names),
        name_of=np.concatenate([np.full(len(problem.boundaries[name]), i) for i, name in enumerate(names)]),
        held=np.array([_HELD[name] for name in names]),
        order=order,
        lam=lam,
        mu=mu,
        force=GRAVITY * material.density[:, None] * np.array(DOWN),
    )


def solve_here(problem: SlipProblem, order: int) -> NDArray[np.float64]:
    """Displacement (N, 3), m, by this package: all of the bar above the fluid, its top in the cap, which is stress-free."""
    system = assemble_system(problem.mesh, problem.material, element="P1" if order == 1 else "P2")
    return solve_system(system, DOWN, 0.0, cap_level=0.99).displacement


def compare(order: int) -> dict[str, object]:
    """Solve the bar by both, now."""
    problem = slip_problem()
    ours, theirs = timed(lambda: solve_here(problem, order)), solve_by_ngsolve(problem, order)
    difference = np.abs(ours.result - theirs.solution).max() / np.abs(theirs.solution).max()
    return {
        "element": f"P{order}",
        "wall, s": ours.wall_s,
        "NGSolve: wall, s": theirs.times_s["assemble_wall_s"] + theirs.times_s["solve_wall_s"],
        "relative difference": float(difference),
    }


def main() -> None:
    """Write NGSolve's answers for linear and quadratic elements."""
    problem = slip_problem()
    answers = {f"P{order}": solve_by_ngsolve(problem, order) for order in (1, 2)}
    STORED.parent.mkdir(exist_ok=True)
    with atomic_path(STORED) as temporary, open(temporary, "wb") as stream:
        versions = {"version": answers["P1"].version}
        np.savez_compressed(stream, nodes=problem.mesh.nodes, **{n: a.solution for n, a in answers.items()}, **versions)


if __name__ == "__main__":
    main()

"""NGSolve as a peer; runs in an environment of its own (`requirements/peers.txt`), so it imports nothing of this project.

    python ngsolve_worker.py problem.npz solution.npz

A problem holds a mesh with named boundaries, Lame parameters and a body force for each element, and which components each
boundary holds; or a sparse SPD matrix (rows, columns, values) and right-hand sides.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from time import perf_counter, process_time

import ngsolve as ngs
import numpy as np
from netgen.meshing import Element2D, Element3D, FaceDescriptor, MeshPoint, Pnt
from netgen.meshing import Mesh as NetgenMesh

COMPONENTS = "xyz"


def mesh_of(nodes: np.ndarray, elements: np.ndarray, facets: np.ndarray, names: list[str], name_of: np.ndarray) -> ngs.Mesh:
    """Copy a tetrahedral mesh; nodes keep their order, facets their boundary's name."""
    mesh = NetgenMesh(dim=3)
    points = [mesh.Add(MeshPoint(Pnt(*map(float, node)))) for node in nodes]
    for number, name in enumerate(names):
        mesh.Add(FaceDescriptor(surfnr=number + 1, domin=1, bc=number + 1))
        mesh.SetBCName(number, name)
    for tet in elements:
        mesh.Add(Element3D(1, [points[i] for i in tet]))
    for triangle, name in zip(facets, name_of, strict=True):
        mesh.Add(Element2D(int(name) + 1, [points[i] for i in triangle]))
    return ngs.Mesh(mesh)


def per_element(mesh: ngs.Mesh, values: np.ndarray) -> ngs.GridFunction:
    """Piecewise constant function."""
    function = ngs.GridFunction(ngs.L2(mesh, order=0))
    function.vec.FV().NumPy()[:] = values
    return function


def elasticity(problem: np.lib.npyio.NpzFile) -> tuple[np.ndarray, dict[str, float]]:
    """Displacement (N, 3) at the nodes of the problem's mesh, and times."""
    names = [str(name) for name in problem["names"]]
    mesh = mesh_of(problem["nodes"], problem["elements"], problem["facets"], names, problem["name_of"])
    held = {
        f"dirichlet{letter}": "|".join(name for name, flags in zip(names, problem["held"], strict=True) if flags[axis])
        for axis, letter in enumerate(COMPONENTS)
    }
    space = ngs.VectorH1(mesh, order=int(problem["order"]), **held)
    u, v = space.TnT()
    lam, mu = per_element(mesh, problem["lam"]), per_element(mesh, problem["mu"])
    force = ngs.CF(tuple(per_element(mesh, column) for column in problem["force"].T))
    strain = lambda w: 0.5 * (ngs.Grad(w) + ngs.Grad(w).trans)  # noqa: E731
    begin, begin_cpu = perf_counter(), process_time()
    stiffness = ngs.BilinearForm(space, symmetric=True)
    stiffness += (lam * ngs.div(u) * ngs.div(v) + 2.0 * mu * ngs.InnerProduct(strain(u), strain(v))) * ngs.dx
    stiffness.Assemble()
    load = ngs.LinearForm(space)
    load += force * v * ngs.dx
    load.Assemble()
    assembled, assembled_cpu = perf_counter(), process_time()
    solution = ngs.GridFunction(space)
    solution.vec.data = stiffness.mat.Inverse(space.FreeDofs(), "sparsecholesky") * load.vec
    times = {
        "assemble_wall_s": assembled - begin,
        "assemble_cpu_s": assembled_cpu - begin_cpu,
        "solve_wall_s": perf_counter() - assembled,
        "solve_cpu_s": process_time() - assembled_cpu,
    }
    # Hierarchical basis: the first dof of each vertex is the value there, component after component.
    count = len(problem["nodes"])
    values = [part.vec.FV().NumPy()[:count] for part in solution.components]
    return np.stack(values, axis=1), times


def matrix(problem: np.lib.npyio.NpzFile) -> tuple[np.ndarray, dict[str, float]]:
    """Solve a sparse SPD system by NGSolve's sparse Cholesky; solutions (n, k), and times."""
    size, rhs = int(problem["size"]), problem["rhs"]
    begin = perf_counter()
    sparse = ngs.la.SparseMatrixd.CreateFromCOO(
        problem["rows"].tolist(), problem["columns"].tolist(), problem["values"].tolist(), size, size
    )
    copied, copied_cpu = perf_counter(), process_time()
    inverse = sparse.Inverse(_all(size), "sparsecholesky")
    factorised, factorised_cpu = perf_counter(), process_time()
    solution = np.empty_like(rhs)
    load, answer = sparse.CreateColVector(), sparse.CreateColVector()
    for column in range(rhs.shape[1]):
        load.FV().NumPy()[:] = rhs[:, column]
        answer.data = inverse * load
        solution[:, column] = answer.FV().NumPy()
    times = {
        "copy_wall_s": copied - begin,
        "factorise_wall_s": factorised - copied,
        "factorise_cpu_s": factorised_cpu - copied_cpu,
        "solve_wall_s": perf_counter() - factorised,
        "solve_cpu_s": process_time() - factorised_cpu,
    }
    return solution, times


def _all(size: int) -> ngs.BitArray:
    mask = ngs.BitArray(size)
    mask.Set()
    return mask


def peak_bytes() -> int:
    """Largest resident set of this program; `ru_maxrss` would count what its starter held when it forked."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    return 0


def main(source: str, target: str) -> None:
    """Solve one problem file."""
    with np.load(source) as problem:
        solve = matrix if "rows" in problem else elasticity
        with ngs.TaskManager():
            solution, times = solve(problem)
    np.savez(target, solution=solution, times=json.dumps(times), version=ngs.__version__, peak_bytes=peak_bytes())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])

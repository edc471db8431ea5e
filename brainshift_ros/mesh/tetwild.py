"""Tetrahedra that follow given surfaces, by fTetWild (Hu et al. 2020), in a process of its own.

fTetWild is C++ that may crash or never end on odd input; a process can be watched and ended, and reports one clear error.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mesh.sizing import SizeField
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm, mm_to_m
from brainshift_ros.worker_process import WorkerResult, run_worker

_REMEDY = "try another number of nodes, or smoother labels"


@dataclass(frozen=True)
class Tetrahedra:
    """What the mesher made.

    Attributes
    ----------
    nodes
        Shape (N, 3), metres.
    elements
        Shape (M, 4), positive volume, outside elements included.
    worker
        Processor time and memory of the mesher's process.
    """

    nodes: NDArray[np.float64]
    elements: NDArray[np.int32]
    worker: WorkerResult


def tetrahedralize(
    surfaces: Sequence[Surface],
    size: SizeField,
    envelope: float,
    *,
    stop_energy: float = 20.0,
    threads: int = 1,
    timeout_s: float = 3600.0,
    waiting: Callable[[float], None] | None = None,
) -> Tetrahedra:
    """Fill the box around the surfaces with tetrahedra whose faces follow them.

    fTetWild draws random numbers: equal input gives similar meshes, not equal ones.

    Parameters
    ----------
    surfaces
        May be open, cross each other and end on each other.
    size
        Target edge lengths.
    envelope
        Largest distance of a followed surface from the given one, metres.
    stop_energy
        Largest conformal AMIPS energy at which optimisation stops; 3 is a regular tetrahedron. A tenth of the time goes
        from 20 down to 12 for a few elements, which moving their nodes repairs at once.
    threads
        One leaves other work its cores.
    timeout_s
        Wall time after which the mesher is ended.
    waiting
        Called a few times a second with the seconds waited so far.

    Raises
    ------
    InputError
        The mesher crashed, gave nothing, or took longer than `timeout_s`.
    """
    offsets = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    vertices_mm = m_to_mm(np.vstack([s.vertices for s in surfaces]))
    faces = np.vstack([s.faces + offset for s, offset in zip(surfaces, offsets, strict=False)])
    diagonal_mm = float(np.linalg.norm(np.ptp(vertices_mm, axis=0)))
    # The watcher of the process removes the folder as well if this process dies.
    with tempfile.TemporaryDirectory(prefix="brainshift-mesh-", ignore_cleanup_errors=True) as folder:
        given, made = Path(folder, "in.npz"), Path(folder, "out.npz")
        np.savez(
            given,
            vertices=vertices_mm,
            faces=faces.astype(np.int32),
            bg_vertices=m_to_mm(size.points),
            bg_tets=size.tetrahedra,
            bg_values=m_to_mm(size.edge),
            edge_length_abs=float(m_to_mm(size.edge.max())),
            epsilon=float(m_to_mm(envelope)) / diagonal_mm,
            stop_energy=stop_energy,
            threads=threads,
        )
        worker = _worked(given, made, threads, timeout_s, waiting)
        with np.load(made) as result:
            nodes, elements = mm_to_m(result["nodes"]), result["elements"].astype(np.int32)
    x = nodes[elements]
    negative = np.linalg.det(x[:, 1:] - x[:, :1]) < 0.0
    elements[negative] = elements[negative][:, [1, 0, 2, 3]]
    return Tetrahedra(nodes, elements, worker)


def _worked(given: Path, made: Path, threads: int, timeout_s: float, waiting: Callable[[float], None] | None) -> WorkerResult:
    try:
        worker = run_worker(
            "brainshift_ros.mesh.tetwild_worker",
            [str(given), str(made)],
            given.parent,
            timeout_s=timeout_s,
            environment={"OMP_NUM_THREADS": str(threads)},
            waiting=waiting,
        )
    except TimeoutError as error:
        raise InputError(
            "mesh", f"fTetWild did not finish in {timeout_s:g} s", "ask for fewer nodes or smoother labels"
        ) from error
    if worker.status != 0 or not made.is_file():
        raise InputError("mesh", f"fTetWild ended with status {worker.status} {worker.last_line}".rstrip(), _REMEDY)
    return worker

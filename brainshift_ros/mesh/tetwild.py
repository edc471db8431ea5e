"""Tetrahedra that follow given surfaces, by fTetWild (Hu et al. 2020), in a process of its own.

fTetWild is C++ that may crash or never end on odd input; a process can be watched and ended, and reports one clear error.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mesh.sizing import SizeField
from brainshift_ros.mesh.surface import Surface
from brainshift_ros.units import m_to_mm, mm_to_m

_POLL_S = 0.2


def tetrahedralize(
    surfaces: Sequence[Surface],
    size: SizeField,
    envelope: float,
    *,
    stop_energy: float = 12.0,
    timeout_s: float = 1800.0,
    waiting: Callable[[float], None] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Fill the box around the surfaces with tetrahedra whose faces follow them.

    Parameters
    ----------
    surfaces
        May be open, cross each other and end on each other.
    size
        Target edge lengths.
    envelope
        Largest distance of a followed surface from the given one, metres.
    stop_energy
        Largest conformal AMIPS energy at which optimisation stops; 3 is a regular tetrahedron.
    timeout_s
        Wall time after which the mesher is ended.
    waiting
        Called a few times a second with the seconds waited so far.

    Returns
    -------
    nodes : ndarray
        Shape (N, 3), metres.
    elements : ndarray
        Shape (M, 4), positive volume, outside elements included.

    Raises
    ------
    InputError
        The mesher crashed, gave nothing, or took longer than `timeout_s`.
    """
    offsets = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    vertices_mm = m_to_mm(np.vstack([s.vertices for s in surfaces]))
    faces = np.vstack([s.faces + offset for s, offset in zip(surfaces, offsets, strict=False)])
    diagonal_mm = float(np.linalg.norm(np.ptp(vertices_mm, axis=0)))
    with tempfile.TemporaryDirectory(prefix="brainshift-mesh-") as folder:
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
        )
        _run_worker(given, made, timeout_s, waiting)
        with np.load(made) as result:
            nodes, elements = mm_to_m(result["nodes"]), result["elements"].astype(np.int32)
    x = nodes[elements]
    negative = np.linalg.det(x[:, 1:] - x[:, :1]) < 0.0
    elements[negative] = elements[negative][:, [1, 0, 2, 3]]
    return nodes, elements


def _run_worker(given: Path, made: Path, timeout_s: float, waiting: Callable[[float], None] | None) -> None:
    # One thread, so that other work keeps its cores.
    # fTetWild draws random numbers: equal input gives similar meshes, not equal ones.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "brainshift_ros.mesh.tetwild_worker", str(given), str(made)]
    with open(made.with_suffix(".log"), "w+b") as log:
        # fTetWild leaves files of its own (__tracked_surface.stl) where it runs: let that be the folder that goes.
        process = subprocess.Popen(command, cwd=given.parent, env=environment, stdout=log, stderr=subprocess.STDOUT)
        start = time.monotonic()
        try:
            while process.poll() is None:
                if waiting is not None:
                    waiting(time.monotonic() - start)
                if time.monotonic() - start > timeout_s:
                    problem = f"fTetWild did not finish in {timeout_s:g} s"
                    raise InputError("mesh", problem, "ask for fewer nodes or smoother labels")
                time.sleep(_POLL_S)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
        if process.returncode != 0 or not made.is_file():
            log.seek(0)
            last = log.read().decode(errors="replace").strip().splitlines()[-1:]
            problem = f"fTetWild ended with status {process.returncode} {' '.join(last)}".rstrip()
            raise InputError("mesh", problem, "try another number of nodes, or smoother labels")

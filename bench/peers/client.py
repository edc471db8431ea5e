"""NGSolve's answers to our problems: arrays out, arrays back, its process and packages apart from ours."""

from __future__ import annotations

import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv" / "peers" / "bin" / "python"
WORKER = Path(__file__).with_name("ngsolve_worker.py")

_TIMEOUT_S = 3600.0


@dataclass(frozen=True)
class PeerAnswer:
    """What NGSolve found, how long its stages took (seconds, wall and CPU), its version and its peak memory.

    `peak_bytes` counts the whole worker.
    """

    solution: NDArray[np.float64]
    times_s: dict[str, float]
    version: str
    peak_bytes: int


def solve_matrix(matrix: sp.csr_matrix, rhs: NDArray[np.float64]) -> PeerAnswer:
    """Solve a sparse SPD system (n, n) for right-hand sides (n, k) by NGSolve's sparse Cholesky."""
    entries = sp.coo_matrix(matrix)
    return ask(size=matrix.shape[0], rows=entries.row, columns=entries.col, values=entries.data, rhs=rhs)


def ask(**problem: object) -> PeerAnswer:
    """Let the worker solve a problem, given as the arrays that ``ngsolve_worker.py`` reads.

    Raises
    ------
    RuntimeError
        The peer's environment is not there, or it failed.
    """
    if not PYTHON.exists():
        raise RuntimeError("NGSolve is not there: `make bench` installs it; by hand: python3 scripts/bootstrap.py --peers")
    with tempfile.TemporaryDirectory(prefix="brainshift-peer-") as folder:
        source, target = Path(folder) / "problem.npz", Path(folder) / "solution.npz"
        np.savez(source, **problem)  # type: ignore[arg-type]
        run = subprocess.run([PYTHON, WORKER, source, target], capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
        if run.returncode != 0:
            raise RuntimeError(f"NGSolve failed: {run.stderr.strip().splitlines()[-1:] or run.returncode}")
        with np.load(target) as made:
            return PeerAnswer(made["solution"], json.loads(str(made["times"])), str(made["version"]), int(made["peak_bytes"]))

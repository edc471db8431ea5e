"""One case of a study in a process of its own, so that its peak memory is its own."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from brainshift_ros.worker_process import run_worker

_TIMEOUT_S = 7200.0


def measured(module: str, arguments: Sequence[object]) -> dict[str, Any]:
    """Run ``python -m module arguments row.json`` and give the row that it wrote, with its peak memory.

    Parameters
    ----------
    module
        Writes the figures of one case, as JSON, to the path that is its last argument.
    arguments
        What stands before it; the working directory is a temporary one.

    Raises
    ------
    RuntimeError
        The case failed; the message is the last line that it wrote.
    """
    with tempfile.TemporaryDirectory(prefix="brainshift-case-", ignore_cleanup_errors=True) as folder:
        made = Path(folder, "row.json")
        worker = run_worker(module, [*map(str, arguments), str(made)], Path(folder), timeout_s=_TIMEOUT_S)
        if worker.status != 0:
            raise RuntimeError(f"{module}, {' '.join(map(str, arguments))}: {worker.last_line}")
        row = json.loads(made.read_text(encoding="utf-8"))
    return {**row, "peak memory, MB": worker.peak_bytes / 1e6}

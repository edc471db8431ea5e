"""Files of a study: summary.json, table.csv, and pictures beside them."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from brainshift_ros import __version__
from brainshift_ros.files import atomic_path


def write_results(folder: Path, summary: Mapping[str, object], rows: Sequence[Mapping[str, object]]) -> None:
    """Write the figures that sum a study up, and the table they come from; every row has the keys of the first."""
    with atomic_path(folder / "summary.json") as temporary:
        temporary.write_text(json.dumps({"software": __version__, **summary}, indent=1), encoding="utf-8")
    write_table(folder / "table.csv", rows)


def write_table(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a table as CSV, whole or not at all; every row has the keys of the first."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_figure(path: Path, figure: Figure) -> None:
    """Write a picture whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)

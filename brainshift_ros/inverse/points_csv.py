"""Points and displacements as people keep them: CSV files in millimetres, patient RAS."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path, existing_file
from brainshift_ros.units import m_to_mm, mm_to_m

POINT_COLUMNS = ("x", "y", "z")
DISPLACEMENT_COLUMNS = ("dx", "dy", "dz")
SIGMA_COLUMN = "sigma"

#: Standard deviation of a displacement component where the file states none, mm.
DEFAULT_SIGMA_MM = 1.0

#: No point of a head lies farther from the image's origin, and nothing in it moves farther; mm.
_FARTHEST_MM = 1000.0
_LONGEST_SHIFT_MM = 100.0


def read_homologous_points(path: str | Path) -> HomologousPoints:
    """Read ``x y z dx dy dz [sigma]``, mm, separated by commas, semicolons, tabs or spaces, with or without a header.

    Raises
    ------
    InputError
        The file is missing or empty, or a value is missing, not a number, or out of range: its line and column are named.
    """
    names = POINT_COLUMNS + DISPLACEMENT_COLUMNS
    table, lines = _read_table(Path(path), names, SIGMA_COLUMN)
    points, displacements = table[:, :3], table[:, 3:6]
    sigma = np.where(np.isnan(table[:, 6]), DEFAULT_SIGMA_MM, table[:, 6])
    _check_positions(path, points, lines)
    for row in np.flatnonzero(np.linalg.norm(displacements, axis=1) > _LONGEST_SHIFT_MM):
        problem = f"line {lines[row]}: a displacement of {np.linalg.norm(displacements[row]):.4g} mm"
        raise InputError(path, problem, f"no brain moves more than {_LONGEST_SHIFT_MM:g} mm; check the units")
    for row in np.flatnonzero(sigma <= 0.0):
        raise InputError(path, f"line {lines[row]}, column sigma: {sigma[row]:g} is not positive", "give it in mm, above 0")
    return HomologousPoints(mm_to_m(points), mm_to_m(displacements), mm_to_m(sigma))


def write_homologous_points(path: str | Path, measured: HomologousPoints) -> None:
    """Write what :func:`read_homologous_points` reads, with a header."""
    columns = np.column_stack([m_to_mm(measured.points), m_to_mm(measured.displacements), m_to_mm(measured.sigma)])
    write_table(path, (*POINT_COLUMNS, *DISPLACEMENT_COLUMNS, SIGMA_COLUMN), columns.tolist())


def read_points(path: str | Path) -> NDArray[np.float64]:
    """Read ``x y z``, mm; further columns are ignored if a header names the three. Returns metres, shape (n, 3).

    Raises
    ------
    InputError
        As for :func:`read_homologous_points`.
    """
    table, lines = _read_table(Path(path), POINT_COLUMNS, None)
    _check_positions(path, table, lines)
    return mm_to_m(table)


def write_table(path: str | Path, names: tuple[str, ...], rows: list[list[float]]) -> None:
    """Write a CSV with a header; numbers get six decimals, which is a nanometre in mm, and integers none."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(names)
        writer.writerows([value if isinstance(value, int) else f"{value:.6f}" for value in row] for row in rows)


def _check_positions(path: str | Path, points_mm: NDArray, lines: list[int]) -> None:
    for row in np.flatnonzero(np.abs(points_mm).max(axis=1) > _FARTHEST_MM):
        problem = f"line {lines[row]}: the point {points_mm[row].tolist()} lies outside any head"
        raise InputError(path, problem, "give patient coordinates in mm, RAS")
    if len(points_mm) > 1 and np.abs(points_mm).max() < 1.0:
        raise InputError(path, "every coordinate is below 1: these look like metres", "give millimetres")


def _read_table(path: Path, names: tuple[str, ...], optional: str | None) -> tuple[NDArray[np.float64], list[int]]:
    """Columns in the order of `names` (then the optional one, NaN where absent), and the line number of each row."""
    path = existing_file(path, "CSV file")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, "is not a text file", "give a CSV file") from error
    lines = [(number, line.split("#")[0].strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line]
    if not lines:
        raise InputError(path, "is empty", f"give lines of {' '.join(names)}")
    allowed = (*names, optional) if optional else names
    first = _cells(lines[0][1])
    if any(_number(cell) is None for cell in first) and any(_plain(cell) in allowed for cell in first):
        order = _header_order(path, lines.pop(0), names, optional)
        width = len(first)
    else:
        order, width = list(range(len(allowed))), None
    if not lines:
        raise InputError(path, "has a header but no points", f"give lines of {' '.join(names)}")
    rows = [_row(path, number, _cells(line), allowed, order, width, len(names)) for number, line in lines]
    return np.array(rows, dtype=np.float64), [number for number, _ in lines]


def _row(
    path: Path, line: int, cells: list[str], allowed: tuple[str, ...], order: list[int], width: int | None, required: int
) -> list[float]:
    right = len(cells) == width if width is not None else required <= len(cells) <= len(allowed)
    if not right:
        wanted = width if width is not None else " or ".join(sorted({str(required), str(len(allowed))}))
        raise InputError(path, f"line {line} has {len(cells)} values, not {wanted}", f"give {' '.join(allowed)} on each line")
    values = []
    for name, column in zip(allowed, order, strict=True):
        if column < 0 or column >= len(cells):
            values.append(math.nan)
            continue
        value = _number(cells[column])
        if value is None or not math.isfinite(value):
            problem = f"line {line}, column {name}: {cells[column]!r} is not a finite number"
            raise InputError(path, problem, "mend or remove this line")
        values.append(value)
    return values


def _header_order(path: Path, header: tuple[int, str], names: tuple[str, ...], optional: str | None) -> list[int]:
    found = [_plain(cell) for cell in _cells(header[1])]
    missing = [name for name in names if name not in found]
    if missing:
        problem = f"line {header[0]}: the header lacks {', '.join(missing)}"
        raise InputError(path, problem, f"name the columns {' '.join(names)}")
    order = [found.index(name) for name in names]
    return order if optional is None else [*order, found.index(optional) if optional in found else -1]


def _cells(line: str) -> list[str]:
    """Split at commas, semicolons or tabs if there are any, else at blanks."""
    parts = re.split(r"[,;\t]", line) if re.search(r"[,;\t]", line) else line.split()
    return [part.strip().strip('"') for part in parts]


def _plain(cell: str) -> str:
    return re.sub(r"[_ ]*\(?mm\)?$", "", cell.strip().lower())


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None

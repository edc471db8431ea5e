"""What `brainshift atlas --show` says of an atlas."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from brainshift_ros.atlas.diagnostics import limits_of_linear_theory, state_name
from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.atlas.file import AtlasFile
from brainshift_ros.atlas.scene import Model, Transient
from brainshift_ros.mechanics.cases import MANNITOL_PRESSURE, SWELLING_PRESSURE
from brainshift_ros.units import m_to_mm


def atlas_table(atlas: AtlasFile) -> Table:
    """Describe an atlas: what it was made of, how, and what each mechanism gives."""
    info = atlas.info()
    table = Table(show_header=False, title=str(atlas.path))
    for key in ("atlas_id", "patient_id", "nodes", "elements", "entries", "software", "created"):
        table.add_row(key, str(info[key]))
    table.add_row("solver", atlas.solver)
    table.add_row("model", _model(atlas.scene.model))
    table.add_row("septa", "yes" if atlas.scene.septa else "no")
    table.add_row("orientations", str(len({entry.gravity_direction for entry in atlas.entries})))
    states = sorted({entry.resected for entry in atlas.entries})
    table.add_row("resection", ", ".join(state_name(state) for state in states))
    for mechanism in info["mechanisms"]:
        table.add_section()
        table.add_row(mechanism, _levels(mechanism, atlas.entries))
        chosen = np.array([entry.mechanism == mechanism for entry in atlas.entries])
        if atlas.diagnostics is not None:
            _add_figures(table, atlas.diagnostics[chosen])
    if atlas.diagnostics is not None:
        table.add_section()
        table.add_row("largest residual", f"{atlas.diagnostics['residual'].max():.1e}")
        for remark in limits_of_linear_theory(atlas.entries, atlas.diagnostics):
            table.add_row("warning", remark)
    return table


def _model(model: Model) -> str:
    time = model.time
    spelt = f"transient, {time.duration_s:g} s in steps of {time.dt_s:g} s" if isinstance(time, Transient) else time
    return f"elements {model.element}, time {spelt}, skull {model.skull}"


def _levels(mechanism: str, entries: tuple[AtlasEntry, ...]) -> str:
    found = [entry for entry in entries if entry.mechanism == mechanism]
    levels = sorted({entry.fluid_level if mechanism == "gravity" else entry.intensity for entry in found})
    if mechanism == "mannitol":
        meaning = f"capillary pressure {MANNITOL_PRESSURE:.0f} Pa, permeability from k_c1 (0) to k_c3 (1)"
    elif mechanism == "swelling":
        meaning = f"capillary pressure, of {SWELLING_PRESSURE:.0f} Pa"
    else:
        meaning = "fluid levels"
    return f"{len(found)} entries; {meaning}: " + ", ".join(f"{level:.2f}" for level in levels)


def _add_figures(table: Table, rows: np.ndarray) -> None:
    shift_mm = m_to_mm(rows["largest_shift"].astype(float))
    table.add_row("  largest shift", f"{shift_mm.min():.1f} to {shift_mm.max():.1f} mm")
    seen_mm = m_to_mm(rows["craniotomy_shift"].astype(float))
    if not np.isnan(seen_mm).any():
        table.add_row("  under the craniotomy", f"{seen_mm.min():.1f} to {seen_mm.max():.1f} mm")
    inverted = int((rows["inverted_elements"] > 0).sum())
    table.add_row("  smallest det F", f"{rows['smallest_det_f'].min():.2f}; elements inverted in {inverted} entries")
    if rows["contact_iterations"].any():
        steps, closed = rows["contact_iterations"], rows["closed_normals"]
        table.add_row("  skull contact", f"{closed.min()} to {closed.max()} normals closed, in at most {steps.max()} steps")

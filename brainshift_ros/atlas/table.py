"""Parameters of the entries as a table of the atlas file, with the physical values that their levels stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import h5py
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.mechanics.cases import MANNITOL_PRESSURE, SWELLING_PRESSURE
from brainshift_ros.mechanics.materials import TissueProperties
from brainshift_ros.mesh.patient import Tissue

#: `capillary_pressure`: p_c, Pa. `exchange_*`: k_c of each tissue, 1/(Pa s). Both follow from the other columns and the
#: atlas's materials; they stand there for readers of the file.
_TABLE = np.dtype(
    [
        ("mechanism", h5py.string_dtype("utf-8", 16)),
        ("gravity_direction", np.float64, (3,)),
        ("fluid_level", np.float64),
        ("drug_level", np.int32),
        ("resected", np.bool_),
        ("intensity", np.float64),
        ("capillary_pressure", np.float64),
        *((f"exchange_{tissue.name.lower()}", np.float64) for tissue in Tissue),
    ]
)


def to_table(entries: Sequence[AtlasEntry], materials: Mapping[Tissue, TissueProperties]) -> NDArray:
    """Table of the entries, shape (m,)."""
    return np.array([_row(entry, materials) for entry in entries], dtype=_TABLE)


def from_table(table: NDArray) -> tuple[AtlasEntry, ...]:
    """Entries of a table."""
    return tuple(
        AtlasEntry(
            mechanism=row["mechanism"].decode(),
            gravity_direction=tuple(float(x) for x in row["gravity_direction"]),  # type: ignore[arg-type]
            fluid_level=float(row["fluid_level"]),
            drug_level=int(row["drug_level"]),
            resected=bool(row["resected"]),
            intensity=float(row["intensity"]),
        )
        for row in table
    )


def _row(entry: AtlasEntry, materials: Mapping[Tissue, TissueProperties]) -> tuple:
    drug = entry.intensity if entry.mechanism == "mannitol" else 0.0  # swelling acts through the pressure alone
    exchange = []
    for tissue in Tissue:
        lowest, highest = materials[tissue].exchange if tissue in materials else (np.nan, np.nan)
        exchange.append(lowest + drug * (highest - lowest))
    pressure = {"mannitol": MANNITOL_PRESSURE, "swelling": SWELLING_PRESSURE * entry.intensity}.get(entry.mechanism, 0.0)
    parameters = (entry.gravity_direction, entry.fluid_level, entry.drug_level, entry.resected, entry.intensity)
    return (entry.mechanism.encode(), *parameters, pressure, *exchange)

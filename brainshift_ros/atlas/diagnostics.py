"""How each entry's solution came about: kept in the atlas file beside the matrix, summed up as warnings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import AtlasEntry

#: One row an entry. `residual`: relative, of the linear systems. `contact_iterations`, `closed_normals`: steps of the skull
#: contact and normals on which the tissue rests in the end; zero without contact. `smallest_det_f`, `inverted_elements`:
#: smallest volume ratio of an element and the number of elements at or below zero. `largest_shift`: m.
#: `craniotomy_shift`: m, on the cortex under the craniotomy; not a number without one.
DIAGNOSTICS = np.dtype(
    [
        ("residual", np.float64),
        ("contact_iterations", np.int32),
        ("closed_normals", np.int32),
        ("smallest_det_f", np.float32),
        ("inverted_elements", np.int32),
        ("largest_shift", np.float32),
        ("craniotomy_shift", np.float32),
    ]
)


def limits_of_linear_theory(entries: Sequence[AtlasEntry], diagnostics: NDArray) -> tuple[str, ...]:
    """Say, for each mechanism and resection state, where the displacements turn elements inside out (spec E8).

    Parameters
    ----------
    entries
        Of the atlas, m.
    diagnostics
        Shape (m,), of :data:`DIAGNOSTICS`.
    """
    remarks = []
    kinds = [(entry.mechanism, entry.resected) for entry in entries]
    for kind in sorted(set(kinds)):
        rows = diagnostics[[k == kind for k in kinds]]
        beyond = rows[rows["inverted_elements"] > 0]
        if len(beyond):
            name = f"{kind[0]}, {state_name(kind[1])}"
            remarks.append(
                f"{name}: in {len(beyond)} of {len(rows)} entries the displacement turns elements inside out "
                f"(at most {beyond['inverted_elements'].max()}, smallest det F {beyond['smallest_det_f'].min():.2f}): "
                "it lies beyond linear theory there"
            )
    return tuple(remarks)


def state_name(resected: bool) -> str:
    """Name of a resection state, for progress, warnings and tables."""
    return "tumour resected" if resected else "with tumour"

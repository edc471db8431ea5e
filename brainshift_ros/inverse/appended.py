"""An atlas with columns that were solved during surgery appended to it: the M-hat of (6.3)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.atlas.entry import RETRACTION, AtlasEntry, WeightGroup
from brainshift_ros.errors import InputError
from brainshift_ros.inverse.atlas_like import AtlasLike
from brainshift_ros.inverse.shift_estimate import EntryWeight
from brainshift_ros.mesh.tetmesh import TetMesh


class AppendedAtlas:
    """An atlas and its appended retraction columns, which are a group of their own.

    Its sum limit is that of the atlas's group `retraction`; the 1 of (6.3) where the atlas has no such group.

    Parameters
    ----------
    atlas
        The patient's atlas of m columns.
    retraction
        Shape (k, N, 3), metres; none if None.

    Raises
    ------
    InputError
        The retraction is of another mesh, or not finite.
    """

    def __init__(self, atlas: AtlasLike, retraction: NDArray[np.float32] | None) -> None:
        count = len(atlas.mesh.nodes)
        retraction = np.zeros((0, count, 3), dtype=np.float32) if retraction is None else np.asarray(retraction)
        if retraction.ndim != 3 or retraction.shape[1:] != (count, 3):
            problem = f"has shape {retraction.shape}, the atlas's mesh needs (k, {count}, 3)"
            raise InputError("retraction", problem, "solve the retraction again on this patient's mesh")
        if not np.isfinite(retraction).all():
            raise InputError("retraction", "holds values that are not finite", "solve the retraction again")
        self._atlas, self._retraction = atlas, retraction
        self._own = len(atlas.entries)

    @property
    def path(self) -> Path:
        """Of the atlas file."""
        return self._atlas.path

    @property
    def mesh(self) -> TetMesh:
        """Of the atlas."""
        return self._atlas.mesh

    @property
    def groups(self) -> tuple[WeightGroup, ...]:
        """Groups of the atlas, the appended columns among those of the group `retraction`; groups without columns left out."""
        appended = tuple(range(self._own, self._own + len(self._retraction)))
        groups = {group.name: group for group in (WeightGroup(RETRACTION, ()), *self._atlas.groups)}
        retraction = groups.pop(RETRACTION)
        joined = replace(retraction, columns=(*retraction.columns, *appended))
        return tuple(group for group in (*groups.values(), joined) if group.columns)

    def rows(self, node_ids: ArrayLike) -> NDArray[np.float64]:
        """Displacements of a few nodes in all columns, shape (n, 3, m + k), metres."""
        own = np.asarray(self._atlas.rows(node_ids), dtype=np.float64)
        appended = self._retraction[:, np.asarray(node_ids)].transpose(1, 2, 0)
        return np.concatenate([own, appended], axis=2)

    def columns(self, ids: NDArray[np.int64]) -> NDArray[np.float32]:
        """Displacements of all nodes in a few columns in ascending order, shape (N, 3, len(ids)), metres."""
        own, appended = ids[ids < self._own], ids[ids >= self._own] - self._own
        parts = [self._atlas.columns(own)] if own.size else []
        return np.concatenate([*parts, self._retraction[appended].transpose(1, 2, 0)], axis=2)

    def describe(self, column: int, weight: float) -> EntryWeight:
        """Return a weight with the parameters of its column."""
        if column >= self._own:
            return EntryWeight(column, weight, RETRACTION)
        entry: AtlasEntry = self._atlas.entries[column]
        return EntryWeight(
            column, weight, entry.mechanism, entry.gravity_direction, entry.fluid_level, entry.drug_level, entry.resected
        )

"""What the inverse model needs of an atlas: met by the atlas file, and by atlases that live in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
from brainshift_ros.mesh.tetmesh import TetMesh


class AtlasLike(Protocol):
    """An atlas of m displacement solutions on a mesh of N nodes."""

    @property
    def path(self) -> Path:
        """Where it lies, for messages."""

    @property
    def atlas_id(self) -> str:
        """Hash of its content."""

    @property
    def patient_id(self) -> str:
        """The patient it was built for."""

    @property
    def mesh(self) -> TetMesh:
        """Mesh whose nodes the rows belong to."""

    @property
    def entries(self) -> tuple[AtlasEntry, ...]:
        """Parameters of each column."""

    @property
    def groups(self) -> tuple[WeightGroup, ...]:
        """Groups of columns that share a sum limit."""

    def rows(self, node_ids: ArrayLike) -> NDArray[np.float32]:
        """Displacements of a few nodes in all entries, shape (n, 3, m), metres."""

    def columns(self, ids: ArrayLike) -> NDArray[np.float32]:
        """Displacements of all nodes in a few entries, shape (N, 3, k), metres."""

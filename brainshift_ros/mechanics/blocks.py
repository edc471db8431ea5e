"""Sums of element matrices into a sparse matrix of 3 x 3 blocks, one for each pair of nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from brainshift_ros.mechanics.scatter import sum_at


@dataclass(frozen=True)
class BlockPattern:
    """Where the pairs of nodes of each element go in a block sparse matrix.

    It is found once; finding it again for each of the nine components, as a triplet format would, costs more than the
    element matrices themselves.

    Attributes
    ----------
    count
        Number of nodes n.
    rows, columns
        Nodes of each block, shape (b,), sorted by row, then by column.
    slot
        Shape (k, k, M), the block of each pair of an element's k nodes.
    """

    count: int
    rows: NDArray[np.integer]
    columns: NDArray[np.integer]
    slot: NDArray[np.integer]

    def add(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum element matrices (k, k, M), row by column by element, into the blocks, (b,)."""
        return sum_at(self.slot, values, len(self.rows))

    def matrix(self, blocks: NDArray[np.float64]) -> sp.csr_matrix:
        """Sparse (3n, 3n) from blocks (b, 3, 3)."""
        starts = np.searchsorted(self.rows, np.arange(self.count + 1))
        return sp.bsr_matrix((blocks, self.columns, starts), shape=(3 * self.count, 3 * self.count)).tocsr()


def block_pattern(elements: NDArray[np.integer], count: int) -> BlockPattern:
    """Pattern of elements (M, k) on `count` nodes."""
    nodes = elements.T.astype(np.int64)
    keys, slot = np.unique(nodes[:, None] * count + nodes[None, :], return_inverse=True)
    rows, columns = np.divmod(keys, count)
    return BlockPattern(count, rows, columns.astype(np.int32), slot.reshape(len(nodes), len(nodes), -1))

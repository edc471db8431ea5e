"""A few columns of an atlas that stand for all: what the uncertainty of a whole field needs, small enough to keep in memory.

Columns of an atlas are alike (a few components hold 99 % of them: study `atlas-content`, thesis chapter V), so two dozen of
them combine to each of the others but for a percent or two. A randomised interpolative decomposition (Liberty, Woolfe,
Martinsson, Rokhlin, Tygert 2007) of the rows of some nodes finds them without reading the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import interpolative

from brainshift_ros.errors import InputError
from brainshift_ros.inverse.atlas_like import AtlasLike

#: Nodes whose rows decide which columns stand for the others.
_NODES = 128

#: Relative error of the other columns that is aimed at, and the most columns that are kept.
_ACCURACY, _MOST = 1e-3, 24


@dataclass(frozen=True)
class AtlasSpan:
    """Columns that combine to all columns of an atlas.

    Attributes
    ----------
    fields
        Shape (N, 3, q), metres per unit weight: the columns that were kept.
    mixing
        Shape (q, m): column j of the atlas is about ``fields @ mixing[:, j]``.
    """

    fields: NDArray[np.float32]
    mixing: NDArray[np.float64]

    def appended(self, retraction: NDArray[np.float32] | None) -> AtlasSpan:
        """Return a span of the atlas with columns solved during surgery, shape (k, N, 3), appended as they are."""
        if retraction is None or len(retraction) == 0:
            return self
        q, m = self.mixing.shape
        mixing = np.zeros((q + len(retraction), m + len(retraction)))
        mixing[:q, :m] = self.mixing
        mixing[q:, m:] = np.eye(len(retraction))
        fields = np.concatenate([self.fields, np.asarray(retraction, dtype=np.float32).transpose(1, 2, 0)], axis=2)
        return AtlasSpan(fields, mixing)


def atlas_span(atlas: AtlasLike) -> AtlasSpan:
    """Find the span of an atlas; some 100 rows and at most 24 columns are read. It does not depend on any measurement.

    Raises
    ------
    InputError
        Columns of the atlas hold values that are not finite.
    """
    count = len(atlas.mesh.nodes)
    rng = np.random.default_rng(0)
    nodes = np.sort(rng.choice(count, min(_NODES, count), replace=False))
    rows = np.asarray(atlas.rows(nodes), dtype=np.float64)
    if not np.isfinite(rows).all():
        raise InputError(atlas.path, "its columns hold values that are not finite", "build the atlas again")
    rows = rows.reshape(-1, rows.shape[-1])
    rows = rng.standard_normal((2 * _MOST, len(rows))) @ rows
    if not rows.any():
        return AtlasSpan(np.zeros((count, 3, 1), dtype=np.float32), np.zeros((1, rows.shape[1])))
    rank, order, others = interpolative.interp_decomp(rows, _ACCURACY, rand=False)
    if rank > _MOST:
        rank = _MOST
        order, others = interpolative.interp_decomp(rows, rank, rand=False)
    mixing = interpolative.reconstruct_interp_matrix(order, others)
    kept = np.argsort(order[:rank])
    return AtlasSpan(np.asarray(atlas.columns(np.sort(order[:rank])), dtype=np.float32), mixing[kept])

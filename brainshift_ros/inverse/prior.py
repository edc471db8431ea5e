"""What is believed of the weights before anything is measured: the uncertainty of a fit that has more columns than data.

The constraints of (3.9) are those of a Dirichlet distribution: weights, and what is left of their limit, are shares of a
whole. Its first two moments serve as a Gaussian prior, as in an ensemble Kalman filter (Evensen 2003), where the spread of an
ensemble of model solutions says how the field may vary. No column is left out because its weight came out as zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import WeightGroup

#: Expected share of a group's limit that no column takes.
_UNUSED = 0.5

#: Spread of the shares: 1 if one column takes all, 0 if all take alike (for a Dirichlet distribution of total concentration c
#: it is 1 / (1 + c)). Tuned as :data:`brainshift_ros.inverse.discrepancy.TYPICAL_ERROR` is.
_SPREAD = 0.6


@dataclass(frozen=True)
class WeightPrior:
    """Mean and covariance of the weights, group by group.

    Attributes
    ----------
    mean
        Shape (m,).
    owner
        Shape (m,), group of each column; columns of no group share one.
    limits
        Shape (groups,).
    """

    mean: NDArray[np.float64]
    owner: NDArray[np.int64]
    limits: NDArray[np.float64]

    @property
    def share(self) -> NDArray[np.float64]:
        """Shape (m,), expected weights as shares of their sum."""
        return self.mean / self.mean.sum()

    @property
    def variance(self) -> NDArray[np.float64]:
        """Shape (m,), diagonal of the covariance."""
        return _SPREAD * self.mean * (self.limits[self.owner] - self.mean)

    def covariance_times(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Multiply the covariance, (m, m), of which nothing is formed, by columns (m, k)."""
        product = (self.limits[self.owner] * self.mean)[:, None] * columns
        for group in range(len(self.limits)):
            members = self.owner == group
            mean = self.mean[members]
            product[members] -= np.outer(mean, mean @ columns[members])
        return _SPREAD * product


def weight_prior(columns: int, groups: Sequence[WeightGroup]) -> WeightPrior:
    """Prior under which all columns of a group are alike.

    Parameters
    ----------
    columns
        Number of columns m.
    groups
        Disjoint groups with their sum limits. Columns of no group get the limit 1 in common.
    """
    owner = np.full(columns, len(groups), dtype=np.int64)
    for index, group in enumerate(groups):
        owner[list(group.columns)] = index
    limits = np.array([*(group.sum_limit for group in groups), 1.0])
    size = np.bincount(owner, minlength=len(limits))
    return WeightPrior((1.0 - _UNUSED) * limits[owner] / size[owner], owner, limits)

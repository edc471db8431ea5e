"""What each mechanism contributes to an estimate, and how well the points tell it from the others (figure 17)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.inverse.uncertainty import ConditionedBrain


@dataclass(frozen=True)
class MechanismShare:
    """One mechanism's part in an estimate.

    Attributes
    ----------
    weight_sum, weight_sum_std
        Sum of its weights, and its standard deviation. Columns of one mechanism differ in size, so the sum may be uncertain
        where the shift is not.
    shift, shift_std
        Its mean displacement at the points along the estimated one, metres: over the mechanisms they add up to the mean
        estimated shift. The deviation is that of the linear model: a brain that is softer than the atlas's looks like more of
        another mechanism, by more than it says.
    """

    weight_sum: float
    weight_sum_std: float
    shift: float
    shift_std: float


def mechanism_shares(
    mechanisms: NDArray[np.str_], weights: NDArray[np.float64], brain: ConditionedBrain
) -> dict[str, MechanismShare]:
    """Split an estimate by mechanism.

    Parameters
    ----------
    mechanisms
        Shape (m,), name of each column's mechanism.
    weights
        Shape (m,).
    brain
        Conditioned on the points in use.
    """
    M = brain.points.rows.reshape(-1, 3, len(weights))
    estimated = M @ weights
    length = np.linalg.norm(estimated, axis=1, keepdims=True)
    directions = np.divide(estimated, length, out=np.zeros_like(estimated), where=length > 0.0)
    along = np.einsum("nc,ncm->m", directions, M) / len(M)
    names = sorted(set(mechanisms.tolist()))
    member = np.stack([mechanisms == name for name in names], axis=1).astype(np.float64)
    sum_std = brain.combination_std(member, weights)
    shift_std = brain.combination_std(member * along[:, None], weights)
    return {
        name: MechanismShare(float(weights @ own), float(of_sum), float((weights * along) @ own), float(of_shift))
        for name, own, of_sum, of_shift in zip(names, member.T, sum_std, shift_std, strict=True)
    }

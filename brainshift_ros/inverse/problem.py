"""The weights' least-squares problem, its optimality conditions, and what every solver returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import WeightGroup


@dataclass(frozen=True)
class WeightProblem:
    """Minimise ``||A a - b||^2``, and for constrained methods ``a >= 0`` and ``sum(a[group]) <= limit`` for each group.

    Attributes
    ----------
    A
        Shape (r, m), the atlas at the measured points, each row divided by its standard deviation (8.3).
    b
        Shape (r,), the measured displacements, divided likewise.
    groups
        Disjoint groups of columns with positive sum limits; columns in no group are only non-negative.

    Raises
    ------
    ValueError
        A is empty, shapes do not match, a value is not finite, groups overlap, or a limit is not positive: the caller's
        mistakes, all of them.
    """

    A: NDArray[np.float64]
    b: NDArray[np.float64]
    groups: tuple[WeightGroup, ...] = ()

    def __post_init__(self) -> None:
        if self.A.ndim != 2 or self.b.shape != self.A.shape[:1]:
            raise ValueError(f"A of shape {self.A.shape} does not match b of shape {self.b.shape}")
        if self.A.size == 0:
            raise ValueError(f"A of shape {self.A.shape} leaves nothing to fit")
        if not (np.isfinite(self.A).all() and np.isfinite(self.b).all()):
            raise ValueError("A and b must be finite")
        columns = [column for group in self.groups for column in group.columns]
        if len(set(columns)) != len(columns):
            raise ValueError("a column belongs to more than one group")
        if columns and not 0 <= min(columns) <= max(columns) < self.A.shape[1]:
            raise ValueError(f"a group names columns outside 0..{self.A.shape[1] - 1}")
        if not all(group.sum_limit > 0.0 and np.isfinite(group.sum_limit) for group in self.groups):
            raise ValueError("sum limits must be positive and finite")

    @cached_property
    def group_of(self) -> NDArray[np.int64]:
        """Shape (m,), index of each column's group, -1 for none."""
        owner = np.full(self.A.shape[1], -1, dtype=np.int64)
        for index, group in enumerate(self.groups):
            owner[list(group.columns)] = index
        return owner

    @cached_property
    def column_norms(self) -> NDArray[np.float64]:
        """Shape (m,), Euclidean length of each column of A."""
        # Twice as fast as `norm`, which makes a squared copy.
        return np.sqrt(np.einsum("ij,ij->j", self.A, self.A))

    @cached_property
    def limits(self) -> NDArray[np.float64]:
        """Shape (g,), the sum limit of each group."""
        return np.array([group.sum_limit for group in self.groups], dtype=np.float64)


@dataclass(frozen=True)
class WeightSolution:
    """What a method found.

    Attributes
    ----------
    weights
        Shape (m,), one weight per column.
    method
        Its name in :data:`brainshift_ros.inverse.methods.METHODS`.
    residual_norm
        ``||A a - b||``, dimensionless because rows are divided by their standard deviation.
    kkt_residual
        Largest violation of the method's own optimality conditions, relative (see :func:`kkt_residual`).
    iterations
        Iterations of the solver, 0 for direct methods.
    converged
        Whether the solver itself ended as intended; trust `kkt_residual` rather than this.
    saturated
        Names of the groups whose sum reached its limit.
    regularisation
        The Tikhonov factor beta^2 that was used, 0 for other methods.
    """

    weights: NDArray[np.float64]
    method: str
    residual_norm: float
    kkt_residual: float
    iterations: int
    converged: bool
    saturated: tuple[str, ...] = ()
    regularisation: float = 0.0


def group_sums(weights: NDArray, groups: Sequence[WeightGroup]) -> NDArray[np.float64]:
    """Sum of the weights of each group, shape (g,)."""
    return np.array([weights[list(group.columns)].sum() for group in groups], dtype=np.float64)


def saturated_groups(weights: NDArray, groups: Sequence[WeightGroup]) -> tuple[str, ...]:
    """Names of the groups whose sum is at its limit."""
    sums = group_sums(weights, groups)
    return tuple(group.name for group, total in zip(groups, sums, strict=True) if total >= group.sum_limit * (1 - 1e-9))


def kkt_residual(problem: WeightProblem, weights: NDArray[np.float64]) -> float:
    """Largest relative violation of the Karush-Kuhn-Tucker conditions of the constrained problem; 0 at the exact answer.

    With the descent direction ``w = A^T (b - A a)`` and one multiplier ``t_g >= 0`` per group (zero while its sum is below
    the limit) the conditions are ``w_i <= t_g(i)``, equality where ``a_i > 0``, ``a >= 0``, ``sum <= limit``. Violations of
    w and of complementarity are divided by the largest column norm times ``||b||`` (their natural size), those of the sums
    by the limit. A candidate comes without multipliers; each group takes the mean of w over its columns, weighted by a.

    Parameters
    ----------
    problem
        The problem.
    weights
        Shape (m,), any candidate answer, from any solver.
    """
    A, b = problem.A, problem.b
    scale = max(float(problem.column_norms.max(initial=0.0) * np.linalg.norm(b)), np.finfo(float).tiny)
    reduced = (b - A @ weights) @ A / scale
    positive = np.maximum(weights, 0.0)
    violation = max(0.0, float(-weights.min(initial=0.0)))
    for group in problem.groups:
        members = list(group.columns)
        slack = 1.0 - float(weights[members].sum()) / group.sum_limit
        total = float(positive[members].sum())
        multiplier = max(0.0, float(positive[members] @ reduced[members]) / total) if total > 0.0 else 0.0
        reduced[members] -= multiplier
        violation = max(violation, -slack, multiplier * slack)
    # A tiny positive weight is as good as zero: weigh equality by the weight, in units of the largest one.
    share = np.clip(weights / max(float(weights.max(initial=0.0)), np.finfo(float).tiny), 0.0, 1.0)
    return max(violation, float(np.abs(np.where(reduced < 0.0, reduced * share, reduced)).max(initial=0.0)))

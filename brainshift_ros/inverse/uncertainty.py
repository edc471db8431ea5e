"""Standard deviation of an estimate at every node, and of its weights.

The brain is taken to move as ``u(x) = E(x) a + d(x)``: columns of the atlas with weights that their limits allow
(:mod:`.prior`), and a discrepancy that no column holds (:mod:`.discrepancy`). Both are Gaussian, so the measured points
condition them in closed form, as in kriging. The variance reported for an estimate is the expected square of its error,

    std(x)^2 = mean over components of ( Var[u(x) | points] + (E[u(x) | points] - estimate(x))^2 ),

so it holds whatever method made the estimate: one that leaves what the points and the atlas make likely pays for it. Noise,
weights that could have been others, and what the atlas lacks all enter by the same rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.inverse.discrepancy import Amplitudes, correlation, likely_amplitudes, local_shift
from brainshift_ros.inverse.gathered import GatheredPoints
from brainshift_ros.inverse.prior import WeightPrior
from brainshift_ros.inverse.span import AtlasSpan

#: Patterns of the discrepancy at the points with a smaller share of its variance than this are left out at the nodes.
_NEGLIGIBLE = 1e-4

#: The points' noise is never taken below this fraction of what the weights may do.
_LEAST_NOISE = 1e-5


@dataclass(frozen=True)
class ConditionedBrain:
    """Weights and discrepancy, given the measured points.

    Attributes
    ----------
    points
        What was measured, r / 3 points.
    prior
        Of the m weights.
    amplitudes
        Size of noise and discrepancy, learnt from the points.
    usual_shift
        Shape (r / 3,), root mean square shift of the atlas's columns at the points, metres.
    shift
        Root mean square of the measured shift without its noise, metres.
    with_points
        Shape (m, r), prior covariance of the weights with the displacements at the points.
    precision
        Shape (r, r), inverse of the covariance of the measured displacements.
    deviation
        Shape (r,), `precision` times the measured less the expected displacements.
    """

    points: GatheredPoints
    prior: WeightPrior
    amplitudes: Amplitudes
    usual_shift: NDArray[np.float64]
    shift: float
    with_points: NDArray[np.float64]
    precision: NDArray[np.float64]
    deviation: NDArray[np.float64]

    def weight_std(self, columns: NDArray[np.int64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Root of the expected squared error (k,) of some columns' (k,) weights in an estimate of all weights (m,)."""
        error = self.prior.mean[columns] - weights[columns]
        return self._root_error(self.prior.variance[columns], self.with_points[columns].T, error)

    def combination_std(self, combinations: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Root of the expected squared error (k,) of linear combinations, shape (m, k), of an estimate's weights (m,)."""
        variance = np.sum(combinations * self.prior.covariance_times(combinations), axis=0)
        error = (self.prior.mean - weights) @ combinations
        return self._root_error(variance, self.with_points.T @ combinations, error)

    def _root_error(self, variance: NDArray, with_points: NDArray, error: NDArray) -> NDArray[np.float64]:
        """Condition quantities of prior variance (k,), covariance (r, k) with the measured ones, and expected error (k,)."""
        variance = variance - np.sum(with_points * (self.precision @ with_points), axis=0)
        return np.sqrt(np.maximum(variance, 0.0) + (error + self.deviation @ with_points) ** 2)

    def node_std(self, nodes: NDArray[np.float64], span: AtlasSpan, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Root of the expected squared error of a component of the estimate that some weights make.

        Parameters
        ----------
        nodes
            Shape (N, 3), metres.
        span
            Of the atlas, with all columns that the prior is about.
        weights
            Shape (m,).

        Returns
        -------
        Shape (N,), metres.
        """
        of_span = span.mixing @ self.prior.covariance_times(span.mixing.T)
        to_points = (span.mixing @ self.with_points).T
        positions = self.points.positions
        at_nodes = _usual_shift(span.fields, (span.mixing * self.prior.share) @ span.mixing.T)
        size, size_at_points = (
            self.amplitudes.error / np.sqrt(3.0) * local_shift(places, self.usual_shift, self.shift)
            for places in (at_nodes, self.usual_shift)
        )
        patterns = _leading(correlation(positions, positions) * np.outer(size_at_points, size_at_points))
        nearby = correlation(nodes.astype(np.float32), positions.astype(np.float32))
        discrepancy = nearby @ (size_at_points[:, None] * patterns).astype(np.float32) * size.astype(np.float32)[:, None]
        error = 3.0 * size**2
        for component, axis in enumerate(np.eye(3)):
            basis = np.hstack([span.fields[:, component], discrepancy])
            seen = np.hstack([to_points, np.kron(patterns, axis[:, None])])  # the basis as the points see it
            gained, mean = -seen.T @ self.precision @ seen, seen.T @ self.deviation
            q = len(of_span)
            gained[:q, :q] += of_span
            mean[:q] += span.mixing @ (self.prior.mean - weights)
            error += np.einsum("nk,nk->n", basis @ gained.astype(np.float32), basis)
            error += (basis @ mean.astype(np.float32)) ** 2
        return np.sqrt(np.maximum(error, 0.0) / 3.0)


def condition(points: GatheredPoints, prior: WeightPrior) -> ConditionedBrain:
    """Condition weights and discrepancy on measured points."""
    with_points = prior.covariance_times(points.rows.T)
    of_weights = points.rows @ with_points
    # A sigma of nearly nothing must not make the covariance singular.
    least = _LEAST_NOISE**2 * float(np.diagonal(of_weights).max())
    noise = _three_components(points.noise) + max(least, float(np.finfo(np.float64).tiny)) * np.eye(len(of_weights))
    usual = np.sqrt((points.rows**2 @ prior.share).reshape(-1, 3).sum(axis=1))
    mean_variance = float(np.mean(np.diagonal(points.noise)))
    mean_square = float(np.mean(points.displacements**2))
    shift = float(np.sqrt(max(3.0 * (mean_square - mean_variance), mean_variance)))
    size = local_shift(usual, usual, shift)
    discrepancy = _three_components(correlation(points.positions, points.positions) * np.outer(size, size) / 3.0)
    unexpected = points.displacements - points.rows @ prior.mean
    amplitudes = likely_amplitudes(unexpected, of_weights, noise, discrepancy)
    covariance = of_weights + amplitudes.sigma_factor**2 * noise + amplitudes.error**2 * discrepancy
    precision = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    return ConditionedBrain(points, prior, amplitudes, usual, shift, with_points, precision, precision @ unexpected)


def _three_components(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance (3 n, 3 n) of three independent components, each of the covariance given."""
    return np.asarray(np.kron(covariance, np.eye(3)), dtype=np.float64)


def _usual_shift(fields: NDArray[np.float32], second_moment: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square shift (N,) of fields (N, 3, q) whose weights have a second moment (q, q)."""
    flat = fields.reshape(-1, fields.shape[-1])
    squares = np.einsum("nk,nk->n", flat @ second_moment.astype(np.float32), flat)
    return np.sqrt(np.maximum(squares.reshape(-1, 3).sum(axis=1), 0.0))


def _leading(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Eigenvectors (n, r) of a covariance (n, n) that hold nearly all of it."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors[:, values > _NEGLIGIBLE * values[-1]])

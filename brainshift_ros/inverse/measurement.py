"""What a measurement must be before anything is made of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError

_SOURCE = "homologous points"


def check_measurement(measured: HomologousPoints, covariance: NDArray[np.float64] | None = None) -> None:
    """Refuse a malformed measurement.

    Parameters
    ----------
    measured
        The points.
    covariance
        Shape (n, n), of a displacement component over the points, metres squared, if errors of neighbours are alike.

    Raises
    ------
    InputError
        There are no points, or arrays do not match, hold values that are not finite, or a deviation is not positive.
    """
    n = len(measured.points)
    if n == 0:
        raise InputError(_SOURCE, "there are none", "measure at least a few points on the exposed cortex")
    arrays = [
        ("points", measured.points, (n, 3)),
        ("displacements", measured.displacements, (n, 3)),
        ("sigma", measured.sigma, (n,)),
    ]
    if covariance is not None:
        arrays.append(("covariance", covariance, (n, n)))
    for name, array, shape in arrays:
        if array.shape != shape:
            raise InputError(_SOURCE, f"{name} has shape {array.shape}, not {shape}", "give one row per point")
        if not np.isfinite(array).all():
            raise InputError(_SOURCE, f"{name} holds values that are not finite", "remove these points")
    if not (measured.sigma > 0.0).all():
        raise InputError(_SOURCE, f"a sigma is {measured.sigma.min():g} m", "sigma must be positive")
    if covariance is not None:
        _check_covariance(covariance)


def _check_covariance(covariance: NDArray[np.float64]) -> None:
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0.0):
        raise InputError(_SOURCE, "their covariance is not symmetric", "give the covariance of one displacement component")
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        remedy = "add the variance of what is not common to the points to its diagonal"
        raise InputError(_SOURCE, "their covariance is not positive definite", remedy) from error

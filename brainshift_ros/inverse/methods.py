"""Every way to find the weights, by name."""

from __future__ import annotations

from collections.abc import Callable

from brainshift_ros.errors import InputError
from brainshift_ros.inverse.constrained import solve_constrained
from brainshift_ros.inverse.problem import WeightProblem, WeightSolution
from brainshift_ros.inverse.reference import solve_clarabel, solve_nnls, solve_osqp
from brainshift_ros.inverse.unconstrained import (
    solve_least_squares,
    solve_tikhonov,
    solve_tikhonov_gcv,
    solve_tikhonov_l_curve,
)

Method = Callable[[WeightProblem], WeightSolution]

#: Name -> solver. `constrained` is the exact active set, the default everywhere; the last three solve the same problem by
#: other means and stand beside it as checks.
METHODS: dict[str, Method] = {
    "constrained": solve_constrained,
    "least_squares": solve_least_squares,
    "tikhonov": solve_tikhonov,
    "tikhonov_gcv": solve_tikhonov_gcv,
    "tikhonov_l_curve": solve_tikhonov_l_curve,
    "nnls": solve_nnls,
    "osqp": solve_osqp,
    "clarabel": solve_clarabel,
}


def solve_weights(problem: WeightProblem, method: str = "constrained") -> WeightSolution:
    """Find the weights by a named method.

    Raises
    ------
    InputError
        There is no such method.
    """
    if method not in METHODS:
        raise InputError("method", f"there is no inverse method {method!r}", f"choose one of {', '.join(METHODS)}")
    return METHODS[method](problem)

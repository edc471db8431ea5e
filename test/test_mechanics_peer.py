"""The same slip problem by NGSolve: numbers of its own assembly, elements and solver, kept in test/data."""

from __future__ import annotations

import numpy as np
import pytest

from bench.peers.slip import STORED, slip_problem, solve_here


@pytest.mark.parametrize("order", [1, 2])
def test_a_slip_problem_agrees_with_ngsolve(order):
    problem = slip_problem()
    ours = solve_here(problem, order)
    with np.load(STORED) as stored:
        np.testing.assert_array_equal(stored["nodes"], problem.mesh.nodes)
        theirs = stored[f"P{order}"]
    assert np.abs(theirs).max() > 1e-3
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-10 * np.abs(theirs).max())

"""The exact active set where weights are hard to tell apart: duplicate, collinear, tiny, opposite and very many columns."""

from __future__ import annotations

from fractions import Fraction
from itertools import chain, combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.inverse.condensing import condensed
from brainshift_ros.inverse.methods import solve_weights
from brainshift_ros.inverse.problem import WeightProblem, group_sums, kkt_residual


def smooth_columns(rng, rows, columns, parameters=6, roughness=1e-3):
    """Columns that vary smoothly with a few parameters, as an atlas's do."""
    P = rng.normal(size=(columns, parameters))
    return np.tanh(0.3 * P @ rng.normal(size=(parameters, rows))).T + roughness * rng.normal(size=(rows, columns))


def mixed(A, rng, size=1.2, noise=0.05, groups=None):
    """Measure the mean of three columns, times `size`, with noise."""
    columns = A.shape[1]
    b = size * A[:, rng.choice(columns, min(3, columns), replace=False)].mean(axis=1)
    b = b + noise * np.abs(b).mean() * rng.normal(size=len(b))
    return WeightProblem(A, b, (WeightGroup("all", tuple(range(columns))),) if groups is None else groups)


def beside(A, rng, distance):
    return np.concatenate([A, A * (1.0 + distance * rng.normal(size=A.shape))], axis=1)


def halves(A):
    middle = A.shape[1] // 2
    return WeightGroup("a", tuple(range(middle))), WeightGroup("b", tuple(range(middle, A.shape[1])), 0.5)


CASES = {
    "duplicates": lambda A, rng: mixed(np.concatenate([A, A], axis=1), rng),
    **{f"{d:g} apart": lambda A, rng, d=d: mixed(beside(A, rng, d), rng) for d in (1e-8, 1e-10, 1e-12, 1e-13, 1e-14)},
    "1e-10 apart, fitted exactly": lambda A, rng: mixed(beside(A, rng, 1e-10), rng, 0.5, 0.0),
    "collinear": lambda A, rng: mixed(np.concatenate([A, 2.0 * A, 0.5 * A], axis=1), rng),
    "opposite": lambda A, rng: mixed(np.concatenate([A, -A], axis=1), rng),
    "opposite, no sums": lambda A, rng: mixed(np.concatenate([A, -A], axis=1), rng, groups=()),
    "zeros among them": lambda A, rng: mixed(np.concatenate([A, np.zeros_like(A)], axis=1), rng),
    "sizes from 1e-8 to 1": lambda A, rng: mixed(A * 10.0 ** rng.uniform(-8, 0, A.shape[1]), rng),
    "sizes from 1e-8 to 1e8": lambda A, rng: mixed(A * 10.0 ** rng.uniform(-8, 8, A.shape[1]), rng),
    "far beyond the sum": lambda A, rng: mixed(A, rng, 50.0),
    "two saturated sums": lambda A, rng: mixed(A, rng, 3.0, groups=halves(A)),
    "one point": lambda A, rng: mixed(A[:3], rng, 0.7),
    "one point, fitted exactly": lambda A, rng: mixed(A[:3], rng, 0.5, 0.0),
    "one row": lambda A, rng: mixed(A[:1], rng, 0.3),
    "rank 1": lambda A, rng: mixed(np.outer(A[:, 0], rng.normal(size=200)), rng),
    "rank 3, fitted exactly": lambda A, rng: mixed(A[:, :3] @ rng.normal(size=(3, 200)), rng, 0.4, 0.0),
    "single precision, rank 6": lambda A, rng: mixed(
        (A[:, :6] @ rng.normal(size=(6, 200))).astype(np.float32).astype(float), rng
    ),
    "all alike": lambda A, rng: mixed(np.ones((72, 200)), rng, 0.3),
    "almost all alike": lambda A, rng: mixed(1.0 + 1e-13 * rng.normal(size=(72, 200)), rng, 0.9),
    "many rows, duplicates": lambda A, rng: mixed(np.tile(smooth_columns(rng, 900, 40), 2), rng),
    "many rows, 1e-10 apart": lambda A, rng: mixed(beside(smooth_columns(rng, 900, 40), rng, 1e-10), rng, 0.7),
    "many rows, rank 3": lambda A, rng: mixed(rng.normal(size=(900, 3)) @ rng.normal(size=(3, 80)), rng, 0.4),
}


@pytest.mark.parametrize("case", CASES)
def test_optimal_to_twelve_digits(case):
    rng = np.random.default_rng(0)
    problem = CASES[case](smooth_columns(rng, 72, 100), rng)
    solution = solve_weights(problem)
    assert solution.converged
    assert solution.kkt_residual < 1e-12
    assert (solution.weights >= 0.0).all()
    assert (group_sums(solution.weights, problem.groups) <= problem.limits * (1.0 + 1e-14)).all()


@pytest.mark.parametrize("case", ["duplicates", "1e-08 apart", "opposite", "two saturated sums", "one point"])
@pytest.mark.parametrize("method", ["nnls", "osqp", "clarabel"])
def test_others_find_no_better_fit(case, method):
    rng = np.random.default_rng(0)
    problem = CASES[case](smooth_columns(rng, 72, 60), rng)
    ours, theirs = solve_weights(problem), solve_weights(problem, method)
    size = np.linalg.norm(problem.b)
    assert theirs.kkt_residual < 1e-6
    assert ours.residual_norm == pytest.approx(theirs.residual_norm, abs=1e-6 * size)
    assert ours.residual_norm <= theirs.residual_norm + 1e-8 * size


def test_what_the_gram_matrix_hides_is_found_in_the_rows():
    # Six directions and the rounding of single precision, which a Gram matrix in double precision cuts off.
    rng = np.random.default_rng(0)
    A = rng.normal(size=(900, 6)) @ np.abs(rng.normal(size=(6, 100)))
    problem = mixed(A * (1.0 + 1e-7 * rng.normal(size=A.shape)), rng, 0.7, 0.5)
    small = condensed(problem)
    assert len(small.A) < 20
    assert kkt_residual(problem, solve_weights(small).weights) > 1e-10
    assert solve_weights(problem).kkt_residual < 1e-14


def test_ten_thousand_columns():
    rng = np.random.default_rng(1)
    problem = mixed(smooth_columns(rng, 72, 10_000), rng)
    solution = solve_weights(problem)
    assert solution.converged
    assert solution.kkt_residual < 1e-12
    assert np.count_nonzero(solution.weights) <= 73


@st.composite
def hard_problems(draw):
    """Random columns with copies, opposites, multiples, zeros and near copies of half of them, some of it several times."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows, columns = draw(st.integers(1, 30)), draw(st.integers(1, 30))
    A = rng.normal(size=(rows, columns))
    if draw(st.booleans()):
        rank = draw(st.integers(1, 4))
        A = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, columns))
    if draw(st.booleans()):
        A = A * 10.0 ** rng.uniform(-8, 0, columns)
    for factor, distance in draw(
        st.lists(st.tuples(st.sampled_from([1.0, 2.0, -1.0, 0.0]), st.sampled_from([0.0, 1e-8, 1e-11, 1e-14])), max_size=3)
    ):
        some = A[:, rng.permutation(A.shape[1])[: (A.shape[1] + 1) // 2]]
        A = np.concatenate([A, factor * some + distance * rng.normal(size=some.shape)], axis=1)
    A = A[:, rng.permutation(A.shape[1])] * 10.0 ** draw(st.integers(-6, 6))
    columns = A.shape[1]
    chosen = rng.choice(columns, min(4, columns), replace=False)
    b = draw(st.sampled_from([0.3, 1.0, -1.0, 1e3])) * (A[:, chosen] @ rng.dirichlet(np.ones(chosen.size)))
    b = b + draw(st.sampled_from([0.0, 1e-9, 0.1])) * np.abs(b).mean() * rng.normal(size=rows)
    cut = draw(st.integers(0, columns))
    limits = draw(st.tuples(*[st.sampled_from([0.5, 1.0, 2.0])] * 2))
    parts = ((range(cut), limits[0]), (range(cut, columns), limits[1]))
    return WeightProblem(A, b, tuple(WeightGroup(str(ids), tuple(ids), limit) for ids, limit in parts if len(ids)))


@settings(max_examples=40, deadline=None)
@given(hard_problems())
def test_optimal_as_far_as_round_off_allows(problem):
    solution = solve_weights(problem)
    # Columns that cancel each other leave the round-off of what they add up to, not of the measurement.
    terms = float(solution.weights @ problem.column_norms)
    cancelled = max(1.0, terms / max(float(np.linalg.norm(problem.b)), 1e-300))
    assert solution.converged
    assert solution.kkt_residual < 1e-12 + 4e-15 * cancelled
    assert (solution.weights >= 0.0).all()
    assert (group_sums(solution.weights, problem.groups) <= problem.limits * (1.0 + 1e-13)).all()


def solved(matrix, right):
    """Solve a square system of fractions, or None if it is singular."""
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    size = len(rows)
    for k in range(size):
        pivot = next((i for i in range(k, size) if rows[i][k] != 0), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [value / rows[k][k] for value in rows[k]]
        rows = [row if i == k else [a - row[k] * c for a, c in zip(row, rows[k], strict=True)] for i, row in enumerate(rows)]
    return [row[-1] for row in rows]


def exact_least_square(A, b, groups):
    """Smallest ``||A a - b||^2`` in rational arithmetic: the best feasible answer over all working sets."""
    A, b = [[Fraction(int(v)) for v in row] for row in A], [Fraction(int(v)) for v in b]
    columns, best = range(len(A[0])), sum(v * v for v in b)
    for free in chain.from_iterable(combinations(columns, k) for k in range(1, len(columns) + 1)):
        for held in chain.from_iterable(combinations(groups, k) for k in range(len(groups) + 1)):
            gram = [[sum(row[i] * row[j] for row in A) for j in free] for i in free]
            sums = [[Fraction(int(i in group.columns)) for i in free] for group in held]
            matrix = [[*g, *(s[k] for s in sums)] for k, g in enumerate(gram)]
            matrix += [[*s, *[Fraction(0)] * len(held)] for s in sums]
            right = [sum(row[i] * v for row, v in zip(A, b, strict=True)) for i in free]
            answer = solved(matrix, right + [Fraction(group.sum_limit) for group in held])
            if answer is None or min(answer[: len(free)]) < 0:
                continue
            weights = dict(zip(free, answer, strict=False))
            if all(sum(weights.get(i, 0) for i in group.columns) <= Fraction(group.sum_limit) for group in groups):
                residual = [sum(row[i] * w for i, w in weights.items()) - v for row, v in zip(A, b, strict=True)]
                best = min(best, sum(r * r for r in residual))
    return best


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 4))
def test_as_good_as_rational_arithmetic(seed, rows, columns):
    rng = np.random.default_rng(seed)
    A, b = rng.integers(-2, 3, (rows, columns)), rng.integers(-4, 5, rows)  # few values: many of them are dependent
    cut = int(rng.integers(0, columns + 1))
    parts = ((range(cut), 1.0), (range(cut, columns), 0.5))
    groups = tuple(WeightGroup(str(ids), tuple(ids), limit) for ids, limit in parts if len(ids))
    solution = solve_weights(WeightProblem(A.astype(float), b.astype(float), groups))
    assert solution.residual_norm**2 == pytest.approx(float(exact_least_square(A, b, groups)), rel=1e-13, abs=1e-26)

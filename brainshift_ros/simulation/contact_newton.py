"""Equilibrium of a finite-strain body that may leave a rigid wall but not cross it: Newton's method with line search.

The unknowns are the displacement u and, at each wall node, a contact force f >= 0 that pushes along the wall's inward normal:

    R(u, f) = f_int(u) - f_ext + sum_i f_i grad g_i(u) = 0,     g_i(u) <= 0,  f_i >= 0,  f_i g_i(u) = 0,

with the penetration g. Each step linearises R and g and solves the linear complementarity problem that results exactly, with
the linear theory's solver (Josephy 1979: Newton's method for generalised equations). Guessing the closed nodes from the last
step instead is cheaper but may cycle: on quadratic facets a vertex carries no force under even pressure, so that many nodes
are undecided.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from brainshift_ros.simulation.hyperelastic import HyperelasticBody
from brainshift_ros.solvers.direct import SolverName
from brainshift_ros.solvers.many import ManySolver

Array = NDArray[np.float64]


class Gap(Protocol):
    """Penetration of the wall's nodes, for displacements (k, 3), m."""

    def __call__(self, u: Array) -> tuple[Array, Array]:
        """Penetration (k,), m, and its gradient (k, 3)."""

    def curvature(self, u: Array) -> Array:
        """Second derivatives of the penetration (k, 3, 3), 1/m."""


#: Converged when the unbalanced force is below this share of the load, and no node crosses the wall by more than this.
FORCE_TOLERANCE, GAP_TOLERANCE_M = 1e-6, 1e-8

#: Newton iterations before a load is given up as too large a step.
ITERATIONS = 25

#: Shares of the stiffness at rest that are added, in turn, to a tangent that is not positive definite: it is none far from
#: equilibrium, and where compressed tissue is about to fold. The step then still leads down the energy.
SHIFTS = (0.0, 0.02, 0.1, 0.4)

_HALVINGS = 6
_SUFFICIENT = 1e-4


class NoEquilibriumError(ArithmeticError):
    """Newton's method found no equilibrium: the load is too large a step from the last, or beyond what the body carries."""


@dataclass(frozen=True)
class Wall:
    """Nodes that a rigid wall stops.

    Attributes
    ----------
    nodes
        Shape (k,), ascending.
    axis
        Shape (k,), the local axis of each that is the wall's normal.
    gap
        Penetration and its gradient.
    """

    nodes: NDArray[np.intp]
    axis: NDArray[np.intp]
    gap: Gap


@dataclass(frozen=True)
class Supports:
    """What holds a body of n nodes.

    Attributes
    ----------
    frames
        Shape (n, 3, 3), rows are each node's local axes; septum normals before the skull's (see ``mechanics.boundary``).
    held
        Shape (n, 3), local axes along which a node does not move.
    wall
        One-sided contact.
    """

    frames: Array
    held: NDArray[np.bool_]
    wall: Wall


@dataclass(frozen=True)
class State:
    """Displacement u (n, 3), m, and contact force (k,), N, positive where a node presses against the wall."""

    u: Array
    force: Array


@dataclass(frozen=True)
class NewtonStep:
    """One iteration: unbalanced force over load, closed nodes, step length, smallest det F, and the share of the load."""

    load: float
    residual: float
    closed: int
    step: float
    smallest_jacobian: float


def at_rest(count: int, wall: Wall) -> State:
    """Return the body before it is loaded."""
    return State(np.zeros((count, 3)), np.zeros(len(wall.nodes)))


def equilibrium(
    body: HyperelasticBody,
    load: Array,
    supports: Supports,
    start: State,
    *,
    fraction: float = 1.0,
    solver: SolverName = "auto",
) -> tuple[State, list[NewtonStep]]:
    """Find the equilibrium under a dead load.

    Parameters
    ----------
    body
        Forces and tangent.
    load
        Shape (n, 3), N, patient frame.
    supports
        Held axes and wall.
    start
        Where to begin; its held axes must be at zero.
    fraction
        Share of the full load that `load` is, for the history.
    solver
        ``auto``, ``pardiso`` or ``scipy``.

    Returns
    -------
    state, history

    Raises
    ------
    NoEquilibriumError
        No convergence in :data:`ITERATIONS` iterations, or no step that reduces the unbalanced force.
    """
    wall = supports.wall
    state, history = start, []
    # A drug's contraction unbalances the body without any load.
    scale = float(max(np.linalg.norm(load), np.linalg.norm(body.internal_force(start.u)))) or 1.0
    for _ in range(ITERATIONS):
        gap, gradient = wall.gap(state.u[wall.nodes])
        frames, slope = _wall_frames(supports, gradient)
        force = body.internal_force(state.u) - load
        unbalanced = _local(frames, force)
        direction, contact, shift = _direction(body, state, supports, frames, unbalanced, gap / slope, solver)
        contact_force = contact / slope
        length, jacobian, residual = _line_search(
            body, load, supports, state, direction, contact_force, shift, FORCE_TOLERANCE * scale
        )
        u = state.u + length * direction
        gap, _ = wall.gap(u[wall.nodes])
        crossing = float(np.max(gap, initial=0.0))
        history.append(NewtonStep(fraction, residual / scale, int((contact_force > 0.0).sum()), length, jacobian))
        state = State(u, contact_force)
        if length == 1.0 and residual <= FORCE_TOLERANCE * scale and crossing <= GAP_TOLERANCE_M:
            return state, history
    raise NoEquilibriumError(f"no equilibrium after {ITERATIONS} Newton iterations; unbalanced: {history[-1].residual:.1e}")


def _wall_frames(supports: Supports, gradient: Array) -> tuple[Array, Array]:
    """Turn the wall nodes' local frames to the wall's present normal; also the gradient's length along it."""
    wall, frames = supports.wall, supports.frames.copy()
    own = frames[wall.nodes]
    earlier = np.arange(3) < wall.axis[:, None]
    normal = gradient - np.einsum("nai,na,naj,nj->ni", own, earlier, own, gradient)
    slope = np.linalg.norm(normal, axis=1)
    pick = np.arange(len(wall.nodes))
    own[pick, wall.axis] = normal / slope[:, None]
    for axis in (0, 1):
        later = wall.axis == axis
        # The axis after the normal: its old tangent made orthogonal; the last one completes the frame.
        if axis == 0:
            tangent = own[later, 1] - np.einsum("ni,ni->n", own[later, 0], own[later, 1])[:, None] * own[later, 0]
            own[later, 1] = tangent / np.linalg.norm(tangent, axis=1)[:, None]
        last = np.cross(own[later, 0], own[later, 1])
        own[later, 2] = last * np.sign(np.einsum("ni,ni->n", last, own[later, 2]))[:, None]
    frames[wall.nodes] = own
    return frames, slope


def _local(frames: Array, vectors: Array) -> Array:
    return np.einsum("nai,ni->na", frames, vectors)


def _direction(
    body: HyperelasticBody,
    state: State,
    supports: Supports,
    frames: Array,
    unbalanced: Array,
    gap: Array,
    solver: SolverName,
) -> tuple[Array, Array, float]:
    """Newton direction (n, 3), patient frame, its contact forces (k,) along the frames' normals, and the shift it took."""
    wall = supports.wall
    one_sided = np.zeros_like(supports.held)
    one_sided[wall.nodes, wall.axis] = True
    to_wall = np.zeros_like(unbalanced)
    to_wall[wall.nodes, wall.axis] = -gap
    stiffness = body.tangent(state.u, frames) + _wall_stiffness(wall, state, frames)
    for shift in SHIFTS:
        if shift > 0.0:
            stiffness = stiffness + shift * body.tangent(np.zeros_like(state.u), frames)
        # In terms of how far a node stays behind the wall the bound is zero, as the solver wants it.
        rhs = -(unbalanced.ravel() + stiffness @ to_wall.ravel())
        try:
            many = ManySolver(stiffness, supports.held.reshape(1, -1), one_sided.reshape(1, -1), solver)
            behind = many.solve_block(rhs[:, None], [0]).solution[:, 0].reshape(-1, 3)
            break
        except ArithmeticError as error:
            # Its text only: kept itself, it would keep this frame and with it a gigabyte of factors.
            fault = str(error)
    else:
        raise NoEquilibriumError(f"the tangent is far from positive definite: {fault}")
    step = to_wall + behind
    step[supports.held] = 0.0
    reaction = -(unbalanced.ravel() + stiffness @ step.ravel()).reshape(-1, 3)
    contact = np.where(behind[wall.nodes, wall.axis] < 0.0, 0.0, np.maximum(reaction[wall.nodes, wall.axis], 0.0))
    return np.einsum("nai,na->ni", frames, step), contact, shift


def _wall_stiffness(wall: Wall, state: State, frames: Array) -> sp.csr_matrix:
    """Contact forces that turn with the wall's normal, f times its curvature, sparse (3n, 3n) in local components."""
    own = frames[wall.nodes]
    blocks = own @ (state.force[:, None, None] * wall.gap.curvature(state.u[wall.nodes])) @ own.swapaxes(1, 2)
    count = len(frames)
    starts = np.searchsorted(wall.nodes, np.arange(count + 1))
    return sp.bsr_matrix((blocks, wall.nodes, starts), shape=(3 * count, 3 * count)).tocsr()


def _line_search(
    body: HyperelasticBody,
    load: Array,
    supports: Supports,
    state: State,
    direction: Array,
    contact_force: Array,
    shift: float,
    negligible: float,
) -> tuple[float, float, float]:
    """Halve the step until no element is inverted and the unbalanced force falls; with a shifted tangent, or the potential.

    The contact forces are the new ones. With these fixed the step d satisfies K d = -R, so that |R| falls along it at first
    if K is the tangent, and the Lagrangian (energy, load and contact) whatever positive definite K is.
    """
    nodes = supports.wall.nodes

    def at(u: Array) -> tuple[float, float, Array]:
        gap, gradient = supports.wall.gap(u[nodes])
        total = body.internal_force(u) - load
        total[nodes] += contact_force[:, None] * gradient
        local = _local(supports.frames, total)
        potential = body.energy(u) - float(np.sum(load * u)) + float(contact_force @ gap)
        return float(np.linalg.norm(local[~supports.held])), potential, total

    before, potential_before, total = at(state.u)
    slope = float(np.sum(total * direction))
    for halving in range(_HALVINGS):
        length = 0.5**halving
        moved = state.u + length * direction
        jacobian = body.smallest_jacobian(moved)
        if jacobian > 0.0:
            residual, potential, _ = at(moved)
            falls = shift > 0.0 and potential <= potential_before + _SUFFICIENT * length * slope
            if falls or residual <= max((1.0 - _SUFFICIENT * length) * before, negligible):
                return length, jacobian, residual
    raise NoEquilibriumError("no step along the Newton direction reduces the unbalanced force or the potential")

"""The two models of the skull above the demarcation plane: a stress-free cap, or one-sided contact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.boundary import CAP_LEVEL
from brainshift_ros.mechanics.system import System

SkullName = Literal["free_cap", "contact"]


def skull_constraints(
    system: System,
    directions: Sequence[tuple[float, float, float]],
    skull: SkullName = "free_cap",
    opening: NDArray[np.bool_] | None = None,
    cap_level: float = CAP_LEVEL,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_] | None]:
    """Constraints of the local dofs for each direction of gravity.

    Parameters
    ----------
    system
        Displacement space of n nodes in a head of N.
    directions
        s directions of gravity.
    skull
        ``free_cap``, the thesis's: above the demarcation nothing holds the brain, nor keeps it from passing the skull.
        ``contact``: it may leave the skull there but not cross it, except in the opening.
    opening
        Shape (N,), nodes under the craniotomy; only ``contact`` looks at it.
    cap_level
        Of the demarcation.

    Returns
    -------
    Dofs held at zero (s, 3n), and those that must not be positive (s, 3n); None for ``free_cap``.

    Raises
    ------
    InputError
        The model is unknown.
    """
    if skull == "free_cap":
        return np.array([system.constrained(direction, cap_level) for direction in directions]), None
    if skull == "contact":
        masks = [system.held_and_one_sided(direction, cap_level, opening) for direction in directions]
        return np.array([held for held, _ in masks]), np.array([one_sided for _, one_sided in masks])
    raise InputError("skull", f"unknown model {skull!r}", "choose free_cap or contact")

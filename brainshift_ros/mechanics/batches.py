"""Which cases are marched together in time: of those with one matrix as many as their dense factors leave room for."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.solvers.direct import BLOCK

Key = TypeVar("Key", bound=Hashable)
Masks = tuple[NDArray[np.bool_], NDArray[np.bool_]]


def batches(
    matrices: Sequence[Hashable], sets: Sequence[Key], masks: Callable[[Key], Masks], dense_bytes: float
) -> Iterator[list[int]]:
    """Group cases.

    A batch keeps a Schur complement on the dofs whose status differs within it, and a dense factor for each of its
    constraint sets, from the first time step to the last. More sets in a batch share one sparse factorisation, but make
    more dofs differ, so the room they need grows faster than their number.

    Parameters
    ----------
    matrices
        Of each case, what tells its matrix from others.
    sets
        Of each case, what tells its constraint set from others. Sets that resemble each other should sort together.
    masks
        Held and one-sided dofs (m,) of a set.
    dense_bytes
        What a batch's dense matrices may fill. A batch of one set is never refused.

    Yields
    ------
    Numbers of the cases of a batch, no more than a block has right-hand sides.
    """
    together: dict[Hashable, dict[Key, list[int]]] = {}
    for number, (matrix, one) in enumerate(zip(matrices, sets, strict=True)):
        together.setdefault(matrix, {}).setdefault(one, []).append(number)
    for of_set in together.values():
        batch: _Batch[Key] = _Batch(masks, dense_bytes)
        for one in of_set:
            for number in of_set[one]:
                if not batch.takes(one):
                    yield batch.cases
                    batch = _Batch(masks, dense_bytes)
                    batch.takes(one)
                batch.cases.append(number)
        yield batch.cases


class _Batch(Generic[Key]):
    """Cases of one batch so far, and the dofs that some or all of its sets constrain."""

    def __init__(self, masks: Callable[[Key], Masks], dense_bytes: float) -> None:
        self.cases: list[int] = []
        self._masks, self._dense_bytes = masks, dense_bytes
        self._sets: set[Key] = set()
        self._some: NDArray[np.bool_] = np.zeros(0, dtype=bool)
        self._held: NDArray[np.bool_] = np.zeros(0, dtype=bool)

    def takes(self, one: Key) -> bool:
        """Make room for another case under a constraint set, if there is any."""
        if len(self.cases) == BLOCK:
            return False
        if one in self._sets:
            return True
        held, one_sided = self._masks(one)
        if not self._sets:
            some, every = held | one_sided, held
        else:
            some, every = self._some | held | one_sided, self._held & held
            variable = int((some & ~every).sum())
            if 8 * variable**2 * (2 + len(self._sets)) > self._dense_bytes:
                return False
        self._sets.add(one)
        self._some, self._held = some, every
        return True

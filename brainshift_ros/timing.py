"""Seconds by stage, as results carry them in `times_s`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def timed(times_s: dict[str, float], stage: str) -> Iterator[None]:
    """Put the wall time of what happens inside ``with`` into `times_s[stage]`, unless it raises."""
    clock = time.perf_counter()
    yield
    times_s[stage] = time.perf_counter() - clock

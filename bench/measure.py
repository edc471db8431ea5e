"""Medians of wall and CPU time over several runs."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Generic, TypeVar

Result = TypeVar("Result")


@dataclass(frozen=True)
class Timed(Generic[Result]):
    """What a function returned on its last run, and how long it took: medians, seconds."""

    result: Result
    wall_s: float
    cpu_s: float


def timed(function: Callable[[], Result], runs: int = 5, warmup: int = 1) -> Timed[Result]:
    """Run a function `warmup` + `runs` times and keep the medians of the counted runs."""
    for _ in range(warmup):
        function()
    wall, cpu = [], []
    for _ in range(runs):
        begin, begin_cpu = perf_counter(), process_time()
        result = function()
        wall.append(perf_counter() - begin)
        cpu.append(process_time() - begin_cpu)
    return Timed(result, statistics.median(wall), statistics.median(cpu))

"""Wall and processor time of a piece of work, its finished child processes included."""

from __future__ import annotations

import resource
import time
from types import TracebackType


class Stopwatch:
    """Measures what happens inside ``with``; :attr:`wall_s` and :attr:`cpu_s` hold seconds afterwards."""

    wall_s = cpu_s = 0.0

    def __enter__(self) -> Stopwatch:
        self._start = time.perf_counter(), _cpu_s()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.wall_s, self.cpu_s = time.perf_counter() - self._start[0], _cpu_s() - self._start[1]


def _cpu_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)

"""Threads of the dense algebra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController


@lru_cache(maxsize=1)
def _openblas() -> ThreadpoolController:
    return ThreadpoolController().select(internal_api="openblas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep NumPy's and SciPy's OpenBLAS to one thread; MKL keeps its own.

    For the many small matrices of some hundred rows. Its threads wait for each other in a busy loop, so on a busy machine a
    Cholesky factorisation of 188 rows took 36 ms with two threads and 0.3 ms with one.
    """
    with _openblas().limit(limits=1):
        yield

"""Compiled work on many states, on all cores (``NUMBA_NUM_THREADS`` where the environment gives it)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from ppcbf_robots.kernels import THREADS

LEAST = 256  # states for each thread; fewer are not worth the handing over

Found = TypeVar("Found")

_threads = THREADS


def use_threads(count: int) -> None:
    """Let kernels of this process work in ``count`` threads from now on: 1 where processes share the cores."""
    global _threads
    _threads = count


def in_threads(count: int, of: Callable[[slice], Found]) -> list[Found]:
    """``of`` slices that together are all of ``count`` states, in order, at once in all threads there are.

    Kernels let go of the interpreter, and what they find of a state does not depend on the others, so the number of
    threads decides the time alone.
    """
    parts = min(_threads, count // LEAST)
    if parts < 2:
        return [of(slice(0, count))]
    ends = [count * k // parts for k in range(parts + 1)]
    return list(_pool(_threads).map(of, map(slice, ends[:-1], ends[1:])))


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)

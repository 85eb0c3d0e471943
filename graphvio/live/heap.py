"""One heap for all threads: images that one thread makes and another drops leave holes that any can fill."""

from __future__ import annotations

import ctypes
import sys

_M_ARENA_MAX = -8  # of glibc's malloc.h


def share_heap() -> bool:
    """Have all threads of this process allocate from one heap: those that have none of their own yet.

    glibc gives threads heaps of their own, between which nothing is exchanged: a process through which images run
    holds what is free in each of them, and grows for minutes. As ``MALLOC_ARENA_MAX=1`` in the environment.

    Returns:
        Whether the C library has such an option. Heaps that there are already remain, and where there are many, more
        are made: call it before threads are started.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and mallopt(_M_ARENA_MAX, 1) == 1

"""Kernels keep count of the arrays that they own, and of no others."""

import gc
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numba import typeof
from numba.core.caching import NullCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import rtsys
from numba.core.runtime._nrt_python import memsys_disable_stats, memsys_enable_stats

from graphvio.arrays import Float
from graphvio.compiled_code import InlinedKernel, Kernel

NUMBERS: Float = np.arange(1.0, 13.0).reshape(3, 4)


@pytest.fixture
def counted() -> Iterator[None]:
    """Numba counts what it allocates."""
    memsys_enable_stats()
    yield
    memsys_disable_stats()


def rows(x: Float) -> float:
    total = 0.0
    for row in x:
        total += row[1]
    return total


def views(x: Float) -> float:
    flat = x.reshape(-1)[1:]
    pair = (flat, flat[2:])
    return float(pair[0][1] + pair[1][0] + x.T[2, 0])


def written(x: Float) -> None:
    first, second = x[0], x[1]
    first[0] = second[1]


def scratch(x: Float) -> float:
    room = np.empty(3)
    for k in range(3):
        room[k] = x[k, 1]
    return float(room.sum())


def expression(x: Float) -> float:
    return float((x + 1.0)[0, 1])


def selection(x: Float) -> float:
    return float(x[0][x[0] > 2.0][0])


def copied(x: Float) -> float:
    return float(x.copy()[0, 1])


def listed(x: Float) -> float:
    numbers = [x[0, 0], x[0, 1]]
    return float(numbers[1])


def returned(x: Float) -> Float:
    return x[1:]


def returned_in_a_tuple(x: Float) -> tuple[float, Float]:
    return 1.0, x[1]


BORROWING: list[Callable[[Float], Any]] = [rows, views, written]
OWNING: list[Callable[[Float], Any]] = [scratch, expression, selection, copied, listed, returned, returned_in_a_tuple]


def compiled(function: Callable[[Float], Any], kind: type = Kernel) -> Any:
    """A kernel that no cache holds."""
    kernel = kind(function, frozenset())
    kernel._cache = NullCache()
    return kernel


def outstanding() -> int:
    """Arrays that numba has allocated and not freed."""
    gc.collect()
    stats = rtsys.get_allocation_stats()
    return int(stats.mi_alloc - stats.mi_free)


@pytest.mark.parametrize("function", [*BORROWING, *OWNING])
def test_only_kernels_that_own_arrays_count_references(function: Callable[[Float], Any]) -> None:
    kernel = compiled(function, InlinedKernel)
    kernel.compile((typeof(NUMBERS),))
    (code,) = kernel.overloads.values()
    with global_compiler_lock:
        module = str(code.library._get_module_for_linking())
    assert bool(re.findall(r"call void @NRT_(?:inc|dec)ref", module)) == (function in OWNING)


@pytest.mark.usefixtures("counted")
@pytest.mark.parametrize("function", [*BORROWING, *OWNING])
def test_kernels_free_what_they_own_and_leave_what_is_lent(function: Callable[[Float], Any]) -> None:
    inner = compiled(function)
    inner.__dict__["_inlined"] = compiled(function, InlinedKernel)

    def called_by_another(x: Float) -> Any:
        return inner(x)

    for kernel in (inner, compiled(called_by_another)):
        lent = NUMBERS.copy()
        expected, references = function(lent.copy()), sys.getrefcount(lent)
        np.testing.assert_equal(kernel(lent), expected)
        before = outstanding()
        for _ in range(20):
            kernel(lent)
        assert outstanding() == before
        assert sys.getrefcount(lent) == references

"""Settings of the process: one heap, and the threads of BLAS."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

_COMMAND = """
import os, sys
from graphvio.cli import main

sys.argv[1:] = ["--version"]
try:
    main()
except SystemExit:
    pass
assert "numpy" not in sys.modules
import numpy

numpy.ones((500, 500)) @ numpy.ones((500, 500))
print(os.environ["OPENBLAS_NUM_THREADS"], len(os.listdir("/proc/self/task")))
"""

_CODE = """
import ctypes, sys, threading
from graphvio.runtime import share_heap

libc = ctypes.CDLL(None)
libc.malloc.argtypes, libc.malloc.restype = [ctypes.c_size_t], ctypes.c_void_p
if sys.argv[1] == "shared":
    assert share_heap()
met = threading.Barrier(6)

def allocate():
    met.wait()
    libc.malloc(100_000)
    met.wait()

threads = [threading.Thread(target=allocate) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
"""


def heaps(how: str) -> int:
    done = subprocess.run([sys.executable, "-c", _CODE, how], capture_output=True, text=True, check=True)
    return done.stdout.count("<heap nr=")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have one heap, or no such option")
def test_share_heap_leaves_one_heap_for_all_threads() -> None:
    assert heaps("own") > 1
    assert heaps("shared") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
@pytest.mark.parametrize("chosen", [None, "3"])
def test_command_line_has_one_blas_thread_unless_the_environment_has_a_number(chosen: str | None) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    if chosen is not None:
        environment["OPENBLAS_NUM_THREADS"] = chosen
    done = subprocess.run(
        [sys.executable, "-c", _COMMAND], capture_output=True, text=True, check=True, env=environment
    )  # fmt: skip
    number, threads = done.stdout.split()[-2:]

    assert number == (chosen or "1")
    assert (threads == "1") == (chosen is None or len(os.sched_getaffinity(0)) == 1)

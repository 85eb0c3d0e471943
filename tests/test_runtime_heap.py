"""All threads of a live run allocate from one heap."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

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

"""Compression after pycolmap is imported, which brings a zlib of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("pycolmap")

_COMPRESS = """
import zlib
for size in range(200):
    made = zlib.compressobj()
    assert zlib.decompress(made.compress(b"abc" * size) + made.flush()) == b"abc" * size
"""
_OPEN = """
from graphvio.errors import OptimizationError
from graphvio.optimization.loops.database import colmap
try:
    colmap()
except OptimizationError as error:
    print(error)
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)


def test_compression_after_graphvio_and_pycolmap_works() -> None:
    done = run("import graphvio, pycolmap\n" + _OPEN + _COMPRESS)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_pycolmap_before_graphvio_is_refused_or_works() -> None:
    done = run("import pycolmap\n" + _OPEN)
    assert done.returncode == 0, done.stderr
    if "pycolmap was imported before zlib" not in done.stdout:  # a wheel without that fault
        works = run("import pycolmap\n" + _OPEN + _COMPRESS)
        assert (works.returncode, works.stdout) == (0, ""), works.stderr

"""Digests of the contents of files. Of files with numbers, only the numbers count, not words or names."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

_NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
_WORDS = "rcl_interfaces/msg/Log"


def joined(parts: Iterable[bytes]) -> str:
    """Return one digest of several parts, which does not depend on their order."""
    return hashlib.sha256(b"".join(sorted(hashlib.sha256(part).digest() for part in parts))).hexdigest()[:16]


def of_files(folder: Path, pattern: str = "*") -> str:
    """Return a digest of the files in a folder: of all bytes, and of their paths in the folder."""
    paths = [path for path in folder.rglob(pattern) if path.is_file()]
    return joined(f"{path.relative_to(folder).as_posix()} ".encode() + path.read_bytes() for path in paths)


def of_texts(paths: Iterable[Path]) -> str:
    """Return a digest of the numbers in text files, as they are written."""
    return joined(b" ".join(_NUMBER.findall(path.read_bytes())) for path in paths)


def of_archives(paths: Iterable[Path]) -> str:
    """Return a digest of all bits of the numerical arrays in archives of numpy."""
    arrays = [array for path in paths for array in dict(np.load(path, allow_pickle=False)).values()]
    return joined(f"{a.dtype.str} {a.shape} ".encode() + a.tobytes() for a in arrays if a.dtype.kind in "biuf")


def of_session(path: Path) -> str:
    """Return a digest of a session's messages except for logs; the file's chunks depend on the time of recording."""
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages()
        return joined(message.data for schema, _, message in messages if schema and schema.name != _WORDS)

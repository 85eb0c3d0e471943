"""Digests of what files hold; where it is numbers, words and names beside them do not count."""

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
    """Make one digest of several parts, whatever their order."""
    return hashlib.sha256(b"".join(sorted(hashlib.sha256(part).digest() for part in parts))).hexdigest()[:16]


def of_files(folder: Path, pattern: str = "*") -> str:
    """Digest the files in a folder byte by byte, with their places in it."""
    paths = [path for path in folder.rglob(pattern) if path.is_file()]
    return joined(f"{path.relative_to(folder).as_posix()} ".encode() + path.read_bytes() for path in paths)


def of_texts(paths: Iterable[Path]) -> str:
    """Digest the numbers in texts, as they are written."""
    return joined(b" ".join(_NUMBER.findall(path.read_bytes())) for path in paths)


def of_archives(paths: Iterable[Path]) -> str:
    """Digest the numerical arrays in numpy's archives, to the last bit."""
    arrays = [array for path in paths for array in dict(np.load(path, allow_pickle=False)).values()]
    return joined(f"{a.dtype.str} {a.shape} ".encode() + a.tobytes() for a in arrays if a.dtype.kind in "biuf")


def of_session(path: Path) -> str:
    """Digest a session's messages but for those in words; how they are packed depends on how long recording took."""
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages()
        return joined(message.data for schema, _, message in messages if schema and schema.name != _WORDS)

"""Parsing of a live source's options as sizes, numbers, choices and names; a `SourceError` explains invalid values."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from graphvio.errors import SourceError
from graphvio.live.sources import SourceSpec

_SIZE = re.compile(r"([1-9]\d{1,4})x([1-9]\d{1,4})")


def size_of(spec: SourceSpec, key: str) -> tuple[int, int] | None:
    """Return a size ``WIDTHxHEIGHT`` in pixels, or None where it is not given."""
    text = spec.options.get(key)
    if text is None:
        return None
    found = _SIZE.fullmatch(text)
    if found is None:
        raise SourceError(f"{spec.kind}: {key} is {text!r}; write WIDTHxHEIGHT in pixels, such as 1280x720")
    return int(found[1]), int(found[2])


def number_of(spec: SourceSpec, key: str, minimum: float, maximum: float, word: str | None = None) -> float | None:
    """Return a number in a range, or None where it is not given.

    Args:
        spec: the source with its options.
        key: name of the option.
        minimum: smallest value.
        maximum: largest value.
        word: a word that the option takes besides numbers, and that the caller has handled; only for the message.

    Raises:
        SourceError: if the value is no number, or outside the range.
    """
    text = spec.options.get(key)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not minimum <= value <= maximum:  # also refuses NaN
        alternative = "" if word is None else f", or {word}"
        raise SourceError(
            f"{spec.kind}: {key} is {text!r}; write a number from {minimum:g} to {maximum:g}{alternative}"
        )
    return value


def whole_number_of(spec: SourceSpec, key: str, minimum: int, maximum: int) -> int | None:
    """Return a whole number in a range, or None where it is not given."""
    value = number_of(spec, key, minimum, maximum)
    if value is not None and not value.is_integer():
        raise SourceError(f"{spec.kind}: {key} is {spec.options[key]!r}; write a whole number")
    return None if value is None else int(value)


def choice_of(spec: SourceSpec, key: str, choices: Sequence[str]) -> str:
    """Return one of several words, the first where none is given."""
    text = spec.options.get(key, choices[0])
    if text not in choices:
        raise SourceError(f"{spec.kind}: {key} is {text!r}; choose one of {', '.join(choices)}")
    return text


def names_of(spec: SourceSpec) -> list[str]:
    """Return the devices that a spec names, separated by commas."""
    if not spec.what:
        return []
    names = spec.what.split(",")
    if not all(names) or len(set(names)) < len(names):
        raise SourceError(f"{spec.kind}: {spec.what!r} names a device twice or not at all; write A,B")
    return names

"""Names in messages: a suggestion for an unknown name, and lists of limited length."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_MIN_SIMILARITY = 0.7  # difflib's ratio; a word that has one letter in two in common is another word
_MAX_LISTED = 8


def nearest(key: str, names: Iterable[str]) -> str:
    """Return a suggestion for the end of a message: the known name that is most similar to an unknown one.

    Args:
        key: the unknown name.
        names: all known names.

    Returns:
        A clause that begins with "; ", or an empty text where no known name is similar.
    """
    close = difflib.get_close_matches(key, list(names), n=1, cutoff=_MIN_SIMILARITY)
    return f"; did you mean {close[0]!r}?" if close else ""


def listed(names: Iterable[str]) -> str:
    """Return a list of names for a message: the first few and the number of the others, or ``none``."""
    known = list(names)
    if len(known) <= _MAX_LISTED + 1:
        return ", ".join(known) or "none"
    return f"{', '.join(known[:_MAX_LISTED])} and {len(known) - _MAX_LISTED} more"

"""Rigs that the simulator knows by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from graphvio.errors import SourceError
from graphvio.rig import Rig, SingleCamera
from graphvio.rig_files import load_rig
from graphvio.simulation.default_rig import default_rig


def stereo() -> Rig:
    """Return the front pair of the default rig."""
    return default_rig().with_pairs([0])


def stereo_and_back() -> Rig:
    """Return the front pair of the default rig, and one camera that looks back."""
    _, back = default_rig().pairs
    return replace(stereo(), singles=(SingleCamera(back.left),))


NAMED_RIGS: dict[str, Callable[[], Rig]] = {"paper": default_rig, "stereo": stereo, "stereo+back": stereo_and_back}
"""Rigs by name; ``paper`` is the default."""


def rig_of(name: str) -> Rig:
    """Return a rig by its name, or from a rig file.

    Raises:
        SourceError: if there is neither.
        RigError: if the file describes no usable rig.
    """
    if name in NAMED_RIGS:
        return NAMED_RIGS[name]()
    if not Path(name).exists():
        raise SourceError(f"there is no rig {name!r}; give a rig file, or one of {', '.join(NAMED_RIGS)}")
    return load_rig(Path(name))

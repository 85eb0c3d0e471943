"""Live sources: one module for each kind, which lists its devices and opens a source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from graphvio.errors import SourceError
from graphvio.live.source import DeviceInfo, LiveSource
from graphvio.rig import Rig
from graphvio.wording import nearest

KINDS = ("v4l2", "realsense", "oak", "ros2", "replay", "simulator")


@dataclass(frozen=True)
class SourceSpec:
    """``KIND[:WHAT][?KEY=VALUE[&KEY=VALUE]]``, such as ``realsense:0123,4567?rate_hz=30``; or a recording's path."""

    kind: str  # kind of source, one of `KINDS`
    what: str = ""  # device, devices separated by commas, path or name; may be empty
    options: Mapping[str, str] = field(default_factory=dict)  # options of the source: key -> value

    @staticmethod
    def parse(text: str) -> SourceSpec:
        """Parse the text of a source on the command line.

        Raises:
            SourceError: if there is no such kind, or an option has no value or two values.
        """
        head, _, tail = text.partition("?")
        kind, _, what = head.partition(":")
        if kind not in KINDS:
            if not head or not Path(head).exists():
                raise _unknown(text, kind)
            kind, what = "replay", head
        options: dict[str, str] = {}
        for each in filter(None, tail.split("&")):
            key, equals, value = each.partition("=")
            if not equals or not key or not value:
                raise SourceError(f"{text}: option {each!r} has no value; write KEY=VALUE")
            if key in options:
                raise SourceError(f"{text}: option {key} is given twice")
            options[key] = value
        return SourceSpec(kind, what, options)


def _unknown(text: str, kind: str) -> SourceError:
    """Return the error for a text that neither begins with a kind nor is an existing path."""
    from graphvio.simulation import SCENE_NAMES

    absent = f"{text}: there is no live source {kind!r} and no recording at that path"
    if kind in SCENE_NAMES:
        return SourceError(
            f"{absent}; the simulated scene of that name is simulator:{text}, or made by  graphvio simulate {kind} "
            f"--out {kind};  a recording elsewhere is replayed by replay:PATH"
        )
    return SourceError(
        f"{absent}{nearest(kind, KINDS)}; live sources are {', '.join(KINDS)}; a recording is replayed by its path or "
        "replay:PATH"
    )


class SourceKind(Protocol):
    """Interface of the modules of this package, one for each kind of source."""

    def list_devices(self) -> Sequence[DeviceInfo]:
        """List the connected devices.

        Raises:
            MissingExtraError: if the vendor's library is not installed.
        """

    def open_source(self, spec: SourceSpec, rig: Rig | None) -> LiveSource:
        """Make a source; nothing is started before its `open`.

        Args:
            spec: what to open, with its options.
            rig: the rig to use, or None for the rig of the source itself.

        Raises:
            SourceError: if an option is not known, or its value is not valid.
            MissingExtraError: if the vendor's library is not installed.
        """


def kind_of(name: str) -> SourceKind:
    """Import and return the module of a kind."""
    return cast(SourceKind, import_module(f"graphvio.live.sources.{name}"))


def open_live_source(text: str, rig: Rig | None = None) -> LiveSource:
    """Make a live source by its text on the command line; see `SourceSpec` and `SourceKind.open_source`."""
    spec = SourceSpec.parse(text)
    return kind_of(spec.kind).open_source(spec, rig)


def check_options(spec: SourceSpec, known: Sequence[str]) -> None:
    """Check that all options of a spec are known to its kind.

    Raises:
        SourceError: if one is not; the message names the nearest known option.
    """
    for key in spec.options:
        if key not in known:
            raise SourceError(
                f"{spec.kind} has no option {key!r}{nearest(key, known)}; it has {', '.join(known) or 'none'}"
            )

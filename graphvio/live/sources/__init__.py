"""Live sources, one file each; each names the kind that it is, lists its devices and opens one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Protocol, cast

from graphvio.config.values import nearest
from graphvio.errors import SourceError
from graphvio.live.source import DeviceInfo, LiveSource
from graphvio.rig import Rig

KINDS = ("v4l2", "realsense", "oak", "ros2", "replay", "simulator")


@dataclass(frozen=True)
class SourceSpec:
    """``KIND[:WHAT][?KEY=VALUE[&KEY=VALUE]]``, such as ``realsense:0123,4567?rate_hz=30``.

    Attributes:
        kind: of source.
        what: device, devices separated by commas, path or name; may be empty.
        options: the source's own.
    """

    kind: str
    what: str = ""
    options: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def parse(text: str) -> SourceSpec:
        """Take a text apart.

        Raises:
            SourceError: if there is no such kind, or an option has no value.
        """
        head, _, tail = text.partition("?")
        kind, _, what = head.partition(":")
        if kind not in KINDS:
            raise SourceError(
                f"{text}: there is no live source {kind!r}{nearest(kind, KINDS)}; there are {', '.join(KINDS)}"
            )
        options: dict[str, str] = {}
        for each in filter(None, tail.split("&")):
            key, equals, value = each.partition("=")
            if not equals or not key or not value:
                raise SourceError(f"{text}: option {each!r} has no value; write KEY=VALUE")
            if key in options:
                raise SourceError(f"{text}: option {key} is given twice")
            options[key] = value
        return SourceSpec(kind, what, options)


class SourceKind(Protocol):
    """What the module of each kind has."""

    def list_devices(self) -> Sequence[DeviceInfo]:
        """What is connected.

        Raises:
            MissingExtraError: if the vendor's library is not installed.
        """

    def open_source(self, spec: SourceSpec, rig: Rig | None) -> LiveSource:
        """The source; nothing is started before its `open`.

        Raises:
            SourceError: if an option is not known, or its value is not valid.
            MissingExtraError: if the vendor's library is not installed.
        """


def kind_of(name: str) -> SourceKind:
    """The module of a kind."""
    return cast(SourceKind, import_module(f"graphvio.live.sources.{name}"))


def open_live_source(text: str, rig: Rig | None = None) -> LiveSource:
    """A live source by what is written on the command line; see `SourceSpec` and `SourceKind.open_source`."""
    spec = SourceSpec.parse(text)
    return kind_of(spec.kind).open_source(spec, rig)


def check_options(spec: SourceSpec, known: Sequence[str]) -> None:
    """Refuse options that a kind does not have.

    Raises:
        SourceError: if there is one; the message names the nearest that it has.
    """
    for key in spec.options:
        if key not in known:
            raise SourceError(
                f"{spec.kind} has no option {key!r}{nearest(key, known)}; it has {', '.join(known) or 'none'}"
            )

"""Shell completion of values of arguments and options; modules that hold the names are imported only when it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pkgutil import resolve_name
from typing import Any, get_args


def _completing(
    where: str, names_in: Callable[[Any], Iterable[str]] = lambda names: names
) -> Callable[[str], list[str]]:
    """Return a completion function for typer that proposes names.

    Args:
        where: ``MODULE:OBJECT``, the object that holds the names.
        names_in: returns the names in this object.
    """

    def complete(incomplete: str) -> list[str]:
        return [name for name in names_in(resolve_name(where)) if name.startswith(incomplete)]

    return complete


profile = _completing("graphvio.config:profiles", lambda profiles: profiles())
scene = _completing("graphvio.simulation:SCENE_NAMES")
named_rig = _completing("graphvio.simulation.named_rigs:NAMED_RIGS")
calibration_component = _completing("graphvio.simulation.calibration_error:COMPONENTS")
rig_change = _completing("graphvio.simulation.rig_change:RIG_CHANGES")
dataset = _completing("graphvio.benchmark.datasets:DATASETS")
session_format = _completing("graphvio.sessions.formats:FORMATS")
live_kind = _completing("graphvio.live.sources:KINDS")
scale_mode = _completing("graphvio.calibration.nuisances:ScaleMode", get_args)
calibration_part = _completing("graphvio.odometry.recorded_calibration:GROUPS", lambda groups: ("pairs", *groups))

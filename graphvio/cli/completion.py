"""What the shell completes as values of arguments and options. Names are imported when it asks: that takes a moment."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import get_args


def _completing(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return the function by which typer completes one of these names."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


def _profiles() -> Iterable[str]:
    from graphvio.config import profiles

    return profiles()


def _scenes() -> Iterable[str]:
    from graphvio.simulation import SCENE_NAMES

    return SCENE_NAMES


def _named_rigs() -> Iterable[str]:
    from graphvio.simulation.named_rigs import NAMED_RIGS

    return NAMED_RIGS


def _calibration_components() -> Iterable[str]:
    from graphvio.simulation.calibration_error import COMPONENTS

    return COMPONENTS


def _rig_changes() -> Iterable[str]:
    from graphvio.simulation.rig_change import RIG_CHANGES

    return RIG_CHANGES


def _datasets() -> Iterable[str]:
    from graphvio.benchmark.datasets import DATASETS

    return DATASETS


def _formats() -> Iterable[str]:
    from graphvio.sessions.formats import FORMATS

    return FORMATS


def _live_kinds() -> Iterable[str]:
    from graphvio.live.sources import KINDS

    return KINDS


def _calibration_parts() -> Iterable[str]:
    from graphvio.odometry.recorded_calibration import GROUPS

    return ("pairs", *GROUPS)


def _scale_modes() -> Iterable[str]:
    from graphvio.calibration.nuisances import ScaleMode

    return get_args(ScaleMode)


profile = _completing(_profiles)
scene = _completing(_scenes)
named_rig = _completing(_named_rigs)
calibration_component = _completing(_calibration_components)
rig_change = _completing(_rig_changes)
dataset = _completing(_datasets)
session_format = _completing(_formats)
live_kind = _completing(_live_kinds)
scale_mode = _completing(_scale_modes)
calibration_part = _completing(_calibration_parts)

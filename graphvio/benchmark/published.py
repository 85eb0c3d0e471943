"""Figures of other systems that were published, with their sources."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import yaml


@dataclass(frozen=True)
class Published:
    """Figures of one system on one data set."""

    system: str
    method: str  # odometry or SLAM, and with which sensors
    source: str  # paper and table
    read_from: str  # where the figures were read: the paper, or a copy of its table
    ate_m: Mapping[str, float]  # sequence -> rmse of positions after SE(3) alignment


def published_on(key: str) -> list[Published]:
    """Return what is known of a data set, by its key; empty if nothing could be verified."""
    return [Published(**each) for each in _document().get(key, {}).get("systems", [])]


def lengths_m(key: str) -> dict[str, float]:
    """Return the lengths of whole sequences of a data set, as far as they are known."""
    return dict(_document().get(key, {}).get("lengths_m", {}))


@cache
def _document() -> Any:
    return yaml.safe_load(resources.files("graphvio.benchmark").joinpath("published.yaml").read_text(encoding="utf-8"))

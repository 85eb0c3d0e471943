"""Fixtures that several test files share."""

from pathlib import Path

import matplotlib
import pytest

from graphvio.simulation import simulate

matplotlib.use("Agg")


@pytest.fixture(scope="session")
def room_walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated recording: 5 s in the room, the first of them at rest, both pairs and the IMU."""
    out = tmp_path_factory.mktemp("simulated") / "room"
    simulate("room", out, duration_s=5.0, seed=3)
    return out

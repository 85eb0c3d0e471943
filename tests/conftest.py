"""Fixtures that several test files share."""

from pathlib import Path

import matplotlib
import pytest
from hypothesis import settings
from rendered import rendered_once

from graphvio.simulation import simulate

matplotlib.use("Agg")

# The first example may compile or load kernels: no deadline. The same examples in each run.
settings.register_profile("graphvio", deadline=None, derandomize=True)
settings.load_profile("graphvio")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take minutes come first, so that no process is left with one at the end."""
    items.sort(key=lambda item: item.get_closest_marker("heavy") is None)


@pytest.fixture(scope="session")
def room_walk() -> Path:
    """A simulated recording: 5 s in the room, the first of them at a standstill, both pairs and the IMU."""
    return rendered_once("room", lambda out: simulate("room", out, duration_s=5.0, seed=3), 5.0, 3)

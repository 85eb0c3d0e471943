"""Fixtures that several test files share."""

import fcntl
import os
from pathlib import Path

import matplotlib
import pytest

from graphvio.simulation import simulate

matplotlib.use("Agg")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take minutes come first, so that no process is left with one at the end."""
    items.sort(key=lambda item: item.get_closest_marker("heavy") is None)


@pytest.fixture(scope="session")
def room_walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated recording: 5 s in the room, the first of them at a standstill, both pairs and the IMU."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # whichever process comes first renders it for all
    out = base / "simulated" / "room"
    out.parent.mkdir(exist_ok=True)
    with (out.parent / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not out.exists():
            unfinished = out.with_name(f"unfinished-{os.getpid()}")
            simulate("room", unfinished, duration_s=5.0, seed=3)
            unfinished.rename(out)
    return out

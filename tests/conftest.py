"""Fixtures that several test files share."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Fixtures import what they need: the process that hands out the tests needs none of it, and is waited for first.
os.environ["MPLBACKEND"] = "Agg"

# The first example may compile or load kernels: no deadline. The same examples in each run.
settings.register_profile("graphvio", deadline=None, derandomize=True)
settings.load_profile("graphvio")


# Files that take from one and a half minutes to five seconds, in this order.
_LONGEST = (
    "page_code", "outages", "optimize", "monocular", "fleet", "cli_slam", "end_to_end", "examples",
    "frontend_covariance", "live", "recorded_calibration", "optimization", "calibrate", "calibration_trajectories",
    "mapping", "odometry", "start_in_motion", "self_calibration", "fleet_s3", "hard_moments", "calibration_methods",
    "corridor", "tutorials", "kernels", "cli_live", "ros2_source", "cli_serve", "simulation_scenes", "slam_service",
    "json_output", "calibration_memory", "calibration_several", "backend_shared_error", "convert", "calibration_pair",
    "keyframes", "viewer_web", "unsynchronised", "docs", "backend_smoother", "live_sources", "overlaps",
    "slam_single_cameras", "sessions", "benchmark", "slam_fuzz", "nav_frame", "warmup", "site", "live_oak",
    "single_cameras", "cli_warming", "ekf_graph", "cli_calibrate_trajectories", "frontend_lucas_kanade", "cli_program",
    "lens_models", "map_frame", "ekf_estimator", "image_masks", "colmap_export", "clock_map",
)  # fmt: skip
_RANKS = {f"test_{name}": rank for rank, name in enumerate(_LONGEST)}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The files that take longest come first, so that no process is left with one at the end."""
    items.sort(key=lambda item: _RANKS.get(item.path.stem, len(_RANKS)))


def pytest_collection_finish() -> None:
    """All modules are loaded for good: the garbage collector need not look through them again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def without_plots() -> Iterator[None]:
    """Results have empty plots."""
    from undrawn import undrawn

    with undrawn():
        yield


@pytest.fixture(scope="session")
def long_room_walk() -> Path:
    """A simulated recording: 10 s in the room, the first of them at a standstill, both pairs of 320x240 and the IMU."""
    from recordings import half_size_rig
    from rendered import rendered_once

    from graphvio.simulation import simulate

    def write(folder: Path) -> None:
        simulate("room", folder, duration_s=10.0, rig=half_size_rig())

    return rendered_once("room", write, "320x240", 10.0)


@pytest.fixture(scope="session")
def room_walk(long_room_walk: Path) -> Path:
    """The first half of the recording."""
    from rendered import copy_part, rendered_once

    return rendered_once("room", lambda folder: copy_part(long_room_walk, folder, 5.0), "320x240", 5.0)


@pytest.fixture(scope="session")
def vga_walk() -> Path:
    """The same five seconds with images of 640x480, the simulator's own, for claims on accuracy that depend on them."""
    from rendered import rendered_once

    from graphvio.simulation import simulate

    return rendered_once("room", lambda folder: simulate("room", folder, duration_s=5.0, seed=3), "640x480", 5.0)


@pytest.fixture(scope="session")
def stereo_and_back_walk() -> Path:
    """Six seconds in the room, the first at a standstill: a pair and a camera that looks back, of 320x240."""
    from recordings import half_size
    from rendered import rendered_once

    from graphvio.simulation import Simulator, build_scene, write_recording
    from graphvio.simulation.named_rigs import stereo_and_back

    def write(folder: Path) -> None:
        rig = stereo_and_back().with_cameras(half_size)
        write_recording(Simulator(build_scene("room", 6.0), rig, 1), folder)

    return rendered_once("room-stereo-back", write, "320x240", 6.0)

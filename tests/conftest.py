"""Fixtures that several test files share."""

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Fixtures import what they need: the process that hands out the tests needs none of it, and is waited for first.
os.environ["MPLBACKEND"] = "Agg"

# Else all sources are compiled again in each process of a command, and the tests in each run.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# The first example may compile or load kernels: no deadline. The same examples in each run.
settings.register_profile("graphvio", deadline=None, derandomize=True)
settings.load_profile("graphvio")


# Files that take from three minutes to five seconds, in this order.
_LONGEST = (
    "optimize", "monocular", "page_code", "outages", "imu_watch", "cli_slam", "fleet", "self_calibration",
    "hard_moments", "recorded_calibration", "end_to_end", "warmup", "corridor", "frontend_covariance", "optimization",
    "fleet_s3", "tutorials", "calibrate", "examples", "live", "benchmark", "mapping", "odometry", "keyframes",
    "json_output", "start_in_motion", "calibration_trajectories", "backend_smoother", "calibration_memory", "kernels",
    "convert", "calibration_methods", "cli_live", "ekf_estimator", "calibration_pair", "calibration_several",
    "backend_shared_error", "unsynchronised", "live_sources", "single_cameras", "slam_service", "docs", "map_frame",
    "simulation_scenes", "ros2_source", "cli_serve", "image_masks", "calibration_start", "slam_single_cameras",
    "sources", "sessions", "overlaps", "colmap_export", "frontend_lucas_kanade", "clock_map", "nav_frame",
    "ros2_publisher", "slam_fuzz", "cli_warming", "image_noise", "ros2_package", "sources_units",
    "cli_calibrate_trajectories", "simulation_calibration_error", "site", "calibration_imu", "real_imu",
    "calibration_motions", "live_oak", "cli_program", "frontend_tracker", "ekf_graph", "imu_noise", "frontend_motion",
    "frontend_extrinsic_monitor", "cli_compare", "evaluation", "spike_filter", "stamp_jitter", "viewer_web",
    "lens_models", "calibration_curves",
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

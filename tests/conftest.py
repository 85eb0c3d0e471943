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


# Files that take from a minute to two seconds, in this order.
_LONGEST = (
    "monocular", "page_code", "optimize", "cli_slam", "outages", "end_to_end", "imu_watch", "examples", "live",
    "warmup", "frontend_covariance", "hard_moments", "corridor", "recorded_calibration", "mapping",
    "self_calibration", "calibrate", "slam_service", "unsynchronised", "odometry", "tutorials", "optimization",
    "keyframes", "ros2_source", "cli_live", "fleet_s3", "json_output", "fleet", "cli_serve", "kernels",
    "start_in_motion", "calibration_trajectories", "simulation_scenes", "backend_smoother", "convert",
    "calibration_start", "backend_shared_error", "benchmark", "calibration_methods", "calibration_several",
    "slam_single_cameras", "calibration_pair", "slam_fuzz", "calibration_memory",
    "sessions", "single_cameras", "nav_frame", "overlaps", "site", "docs", "image_masks", "cli_warming",
    "simulation_calibration_error", "sources", "live_oak", "image_noise", "ros2_package", "colmap_export",
    "real_imu", "cli_calibrate_trajectories", "ros2_publisher", "ekf_estimator", "simulation_rendering",
    "linear_algebra", "simulation_recording", "rig_files", "ekf_graph", "calibration_curves", "clock_map",
    "plotting", "simulation_named_rigs", "time_offset", "turning_on_the_spot", "map_frame",
    "trajectory_formats", "simulation_motion", "optimization_report", "cli_program",
    "self_calibration_singles", "live_sources", "stamp_jitter", "calibration_imu", "ros2_discovery", "interrupts",
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

"""Warm-up, which compiles or loads from the cache every kernel of the odometry, before the first image arrives.

Compiling takes a minute of one core. Where the cache is empty, two other processes do it: one for tracking and IMU; one
for the estimation of motions, or the window of single cameras, and afterwards for the self-calibration, which waits for
it while the odometry may begin. This process stays as small as with a full cache. If another program compiles at the
same time, the warm-up waits for it.
"""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from typing import IO

import gtsam
import numpy as np

from graphvio.backend.inertial import NO_SAMPLES, ImuBuffer
from graphvio.backend.noise import own_covariance
from graphvio.backend.preintegration import preintegrate, preintegration_params
from graphvio.backend.propagation import Propagator
from graphvio.backend.states import RigState
from graphvio.backend.time_offset import integrated_rates
from graphvio.config import Config
from graphvio.frontend.depth.motion_slants import warm_up_motion_slants
from graphvio.frontend.depth.motion_stereo import FirstSights, MotionHistory
from graphvio.frontend.depth.tracks import common_rows
from graphvio.frontend.motion.cost import camera_motions
from graphvio.frontend.motion.depth_errors import by_depth_errors
from graphvio.frontend.motion.depth_scale import with_unknown_scales
from graphvio.frontend.motion.observations import Observations, RigArrays, correspond
from graphvio.frontend.motion.readout_errors import derivatives_by_readout
from graphvio.frontend.motion.selection import best_pair_motion, searched_and_refined
from graphvio.frontend.pairs.extrinsic_monitor import warm_up_extrinsic_monitor
from graphvio.frontend.singles import SinglesFrontend
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion, pixels_at_lines, turned_rays
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.geometry import se3, se3_adjoint, se3_exp, se3_inverse, se3_log, skew, so3_log
from graphvio.kernel_cache import any_compiled_before, cache_root
from graphvio.kernels import announce_compilation, await_compilers, compile_elsewhere, is_compiling_elsewhere
from graphvio.linear_algebra import squared_length
from graphvio.measurements.sensors import GRAVITY_M_S2, FrameSet, ImuSample
from graphvio.monocular.warm_up import warm_up_keyframe_window
from graphvio.png import undo_filters
from graphvio.rig import Imu, Rig
from graphvio.self_calibration.warm_up import warm_up_adjustment
from graphvio.slam.landmarks import orientations

_POINTS = 20
_CALIBRATION = "graphvio.self_calibration.bundle"
_COMPILED_LAST = ("graphvio.frontend.imaging.lucas_kanade", "graphvio.backend.propagation")
_MOTION, _WINDOW = "graphvio.frontend.motion.refinement", "graphvio.self_calibration.moving_landmarks"
_OTHER_PROCESS = "import sys; from graphvio.warmup import compile_for_another; compile_for_another(sys.argv[1])"
_PARTS = ("tracking", "motion")
_IS_COMPILED = b"."  # written by a process when it has compiled the kernels for a first pose
_NEW_OBJECTS = 20_000  # between garbage collections; with Python's 700 they take an eighth of the time


def warm_up(rig: Rig, config: Config, *, wait_for_calibration: bool = True) -> None:
    """Call every kernel once on noise, with the array types that the odometry uses.

    Args:
        rig: the rig, for its image size and its IMU.
        config: configuration of all stages.
        wait_for_calibration: whether to wait also for the kernels of the self-calibration where they have to be
            compiled; else the self-calibration waits for them when it needs them.
    """
    if not rig.pairs:  # the window estimates the calibration, with its own kernels
        config = replace(config, calibration=replace(config.calibration, online=False))
    if not _are_compiled(rig, config):
        _compile_in_parallel(rig, config)
    for part in _PARTS:
        _warm_up_part(part, rig, config)
    if config.estimates_calibration and (wait_for_calibration or not is_compiling_elsewhere()):
        await_compilers()
        warm_up_adjustment(rig)


def compile_for_another(part: str) -> None:
    """Compile one of the `_PARTS` as a separate process; after the motions, compile kernels that are needed later.

    Args:
        part: name of the part; its rig and configuration are read, pickled, from the standard input.
    """
    gc.set_threshold(_NEW_OBJECTS)
    rig, config = pickle.load(sys.stdin.buffer)
    _warm_up_part(part, rig, config)
    os.write(sys.stdout.fileno(), _IS_COMPILED)
    if part == "motion" and config.estimates_calibration:
        warm_up_adjustment(rig)
    if part == "motion" and not rig.pairs:
        _warm_up_motion(rig, config)  # kernels for loop closure


def _warm_up_part(part: str, rig: Rig, config: Config) -> None:
    """Call one half of the kernels that a first pose needs."""
    if part == "tracking":
        _warm_up_tracking(rig, config)
        _warm_up_imu(rig.imu or Imu())
    elif rig.pairs:
        _warm_up_motion(rig, config)
    else:
        warm_up_keyframe_window(rig)


def _are_compiled(rig: Rig, config: Config) -> bool:
    """Return whether the cache holds the kernels, judged by the modules that are compiled last."""
    modules = [*_COMPILED_LAST, _MOTION if rig.pairs else _WINDOW]
    if config.estimates_calibration:
        modules.append(_CALIBRATION)
    return all(any_compiled_before(module) for module in modules)


def _compile_in_parallel(rig: Rig, config: Config) -> None:
    """Compile the kernels in two other processes; only one program does so at a time.

    Return once both have compiled the kernels for a first pose, or have failed: missing kernels are then compiled in
    this process. The other processes hold the lock until they have finished.
    """
    with (cache_root() / "compiling.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if _are_compiled(rig, config):
            return  # compiled by another program meanwhile
        announce_compilation()
        compilers = [_started(part, pickle.dumps((rig, config)), lock) for part in _PARTS]
        for compiler in compilers:
            assert compiler.stdout is not None
            compiler.stdout.read(len(_IS_COMPILED))


def _started(part: str, rig_and_config: bytes, lock: IO[str]) -> subprocess.Popen[bytes]:
    """Start a process that compiles a part, and return it."""
    command, pipe = [sys.executable, "-c", _OTHER_PROCESS, part], subprocess.PIPE
    compiler = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, pass_fds=[lock.fileno()])
    compile_elsewhere(compiler)
    assert compiler.stdin is not None
    with suppress(BrokenPipeError):  # the process has failed, for instance because it does not find graphvio
        compiler.stdin.write(rig_and_config)
        compiler.stdin.close()
    return compiler


def _track_singles(rig: Rig, config: Config, rng: np.random.Generator) -> None:
    """Call the kernels that find tracks of single cameras in each other's images."""
    frontend = SinglesFrontend(rig, config)
    for stamp_ns in range(2):
        images = [rng.integers(0, 256, size=camera.size_px[::-1], dtype=np.uint8) for camera in rig.cameras]
        frontend.process(FrameSet(stamp_ns, {j: (image,) for j, image in enumerate(images)}), lambda _: np.eye(4))
    frontend.close()
    warm_up_motion_slants(rig.cameras[0])


def _warm_up_tracking(rig: Rig, config: Config) -> None:
    """Call the kernels of tracking and of geometry."""
    rng = np.random.default_rng(0)
    group = rig.groups[0]
    tracker = GroupTracker(group, config)
    noise, in_right = (
        rng.integers(0, 256, size=camera.size_px[::-1], dtype=np.uint8) for camera in (group.left, group.cameras[-1])
    )
    for stamp_ns in range(2):
        frame = tracker.observe(stamp_ns, noise, in_right, np.eye(4), np.eye(4))
        tracker.keep_keyframe_patches()
    correspond({0: frame}, {0: frame})
    if rig.singles:
        history = MotionHistory()
        history.restart(frame.stamp_ns)
        FirstSights().locate(frame.ids, frame.left_rays, history, np.eye(4), 1.0, 1.0)
    if not rig.pairs:
        _track_singles(rig, config, rng)
    if any(camera.line_time_us for camera in rig.cameras):
        readout = ReadoutMotion.steady(np.eye(4), 1.0)
        pixels_at_lines(group.left, frame.pixels, np.zeros(len(frame.ids)), readout)
        if rig.singles:
            turned_rays(group.left, frame.pixels, readout)
    undo_filters(np.frombuffer(bytes(2), dtype=np.uint8).reshape(1, 2), 1, np.zeros((2, 1), dtype=np.uint8))
    common_rows(frame.ids, frame.ids)
    orientations(noise, np.full((1, 2), 20.0))
    group.left.project(np.ones((1, 3)))
    se3(np.eye(3), np.zeros(3))
    se3_exp(np.zeros(6))
    skew(np.zeros(3))
    own_covariance(np.eye(6), np.eye(6))
    squared_length(np.zeros(6), np.eye(6))
    for pose in (np.eye(4), np.asfortranarray(np.eye(4))):  # gtsam's matrices are in Fortran's order
        se3_log(pose)
        se3_inverse(pose)
        se3_adjoint(pose)
        so3_log(pose[:3, :3].copy(order="K"))


def _warm_up_motion(rig: Rig, config: Config) -> None:
    """Call the kernels that estimate a motion from points."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (_POINTS, 2)), rng.uniform(0.1, 1.0, _POINTS)])
    observations = Observations(
        np.zeros(_POINTS, dtype=np.int64),
        points,
        np.tile(1e-6 * np.eye(3), (_POINTS, 1, 1)),
        np.ascontiguousarray(points[:, :2]),
        np.ascontiguousarray(points[:, :2]),
        np.ones(_POINTS, dtype=bool),
    )
    for solve in (searched_and_refined, best_pair_motion):
        solve(RigArrays.of(rig), observations, np.eye(4), config.motion, rng)
    arrays = RigArrays.of(rig)
    motion = searched_and_refined(arrays, observations, np.eye(4), config.motion, rng)
    warm_up_extrinsic_monitor(motion)
    by_depth_errors(arrays, observations, motion.inlier, np.eye(4))
    if any(camera.line_time_us for camera in rig.cameras):
        derivatives_by_readout(
            arrays, observations, motion.inlier, np.eye(4), config.motion.pixel_sigma_px, np.zeros((2, _POINTS))
        )
    if rig.pairs and rig.singles:
        camera_motions(motion.cur_T_ref, arrays)
        of_single = np.full(_POINTS, len(rig.pairs))
        with_unknown_scales(arrays, observations._replace(pair=of_single), motion, config.motion)


def _warm_up_imu(imu: Imu) -> None:
    """Call the kernels that process IMU samples."""
    buffer, up = ImuBuffer(1e3), np.array([0.0, 0.0, GRAVITY_M_S2])
    for stamp_ns in range(0, 40_000_000, 10_000_000):
        buffer.add(ImuSample(stamp_ns, np.zeros(3), up))
    for end_ns in (5_000_000, 25_000_000):  # to numba, one row of several columns is another type than many rows
        interval = buffer.interval(0, end_ns)
        assert interval is not None
        integrated_rates(interval.steps_s, interval.angular_velocity)
        preintegrate(interval, preintegration_params(imu, 1.0), gtsam.imuBias.ConstantBias())
    for pose in (np.eye(4), np.asfortranarray(np.eye(4))):
        state = RigState(pose, np.zeros(3), np.zeros(3), np.zeros(3))
        for samples in (buffer.since(0), NO_SAMPLES):
            propagator = Propagator(1e3, 1e3)
            propagator.restart(0, state, 0, np.zeros(3), *samples)
            propagator.predict(35_000_000)

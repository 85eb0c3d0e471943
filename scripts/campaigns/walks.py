"""Walks of the simulator's scenes, with IMU readings that are sampled for each seed."""

from __future__ import annotations

import numpy as np

from graphvio.backend.inertial import ImuBuffer
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Imu
from graphvio.simulation import build_scene
from graphvio.simulation.imu import ImuTrack, measure

SCENES = ("room", "stairs", "calibration", "corridor")
FRAMES_HZ = 20


class Walk:
    """The truth of a walk, and the measurements of an IMU on it.

    Args:
        seed: seed of the IMU's errors; consecutive seeds use different scenes in turn.
        duration_s: duration of the walk.

    Attributes:
        imu: model of the IMU.
        track: samples of the IMU, with their biases.
        stamps_ns: (N,) stamps of the framesets.
        world_T_body: (N, 4, 4) true poses at the framesets.
        velocity_world: (N, 3) true velocities at the framesets, m/s.
        angular_velocity: (N, 3) true angular velocities of body at the framesets, rad/s.
    """

    def __init__(self, seed: int, duration_s: float) -> None:
        self.imu = Imu()
        motion = build_scene(SCENES[seed % len(SCENES)], duration_s + 1.0).motion
        times = np.arange(round((duration_s + 0.5) * self.imu.rate_hz)) / self.imu.rate_hz
        self.track = measure(motion, self.imu, times, np.round(times * 1e9).astype(np.int64), seed)
        self.stamps_ns = [round(k * 1e9 / FRAMES_HZ) for k in range(round(duration_s * FRAMES_HZ) + 1)]
        states = motion.at(np.array(self.stamps_ns) * 1e-9)
        self.world_T_body, self.velocity_world = states.world_T_body, states.velocity
        self.angular_velocity = states.angular_velocity


def buffer_of(track: ImuTrack) -> ImuBuffer:
    """Return the samples in a buffer, as the back-end uses them."""
    buffer = ImuBuffer(50.0)
    for stamp, rate, force in zip(
        track.stamps_ns.tolist(), track.angular_velocity, track.linear_acceleration, strict=True
    ):
        buffer.add(ImuSample(stamp, rate, force))
    return buffer

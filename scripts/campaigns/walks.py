"""Walks of the simulator's scenes, with an IMU of their own for each seed."""

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
    """A walk's truth and the measurements of an IMU on it.

    Args:
        seed: of the IMU; the scenes take turns.
        duration_s: of the walk.

    Attributes:
        imu: the IMU's model.
        track: its samples with their biases.
        stamps_ns: (N,) of the framesets.
        world_T_body: (N, 4, 4) at the framesets.
        velocity_world: (N, 3) there, m/s.
        angular_velocity: (N, 3) there, rad/s of body.
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
    """The samples as the back-end holds them."""
    buffer = ImuBuffer(50.0)
    for stamp, rate, force in zip(
        track.stamps_ns.tolist(), track.angular_velocity, track.linear_acceleration, strict=True
    ):
        buffer.add(ImuSample(stamp, rate, force))
    return buffer

"""A synthetic odometry to be served: real broadcasts and log, random keyframes and estimates."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3, so3_exp
from graphvio.measurements.estimate import Estimate, Prediction, Status
from graphvio.measurements.events import Event
from graphvio.measurements.motion import Quality
from graphvio.queues import Broadcast
from graphvio.rig import Camera, Imu, Rig, StereoPair
from graphvio.slam.keyframe import CorrectionResult, Keyframe, Landmarks
from graphvio.slam.keyframe_log import KeyframeLog

START_NS = 1_403_636_579_763_555_584
SIZE_PX = (64, 48)


def rig(mask: Path | None = None) -> Rig:
    def camera(name: str, turn: float, y: float) -> Camera:
        body_T_cam = se3(so3_exp(np.array([0.1, turn, 0.3])), np.array([0.01, y, 0.02]))
        intrinsics = np.array([40.1, 40.2, 31.7, 23.9])
        return Camera(name, "equidistant", SIZE_PX, intrinsics, np.array([0.1, 1e-5, 1 / 3, 0.0]), body_T_cam, mask)

    front = StereoPair("front", camera("cam0", 0.2, 0.05), camera("cam1", 0.2, -0.05))
    back = StereoPair("back", camera("cam2", 3.2, 0.05), camera("cam3", 3.2, -0.05))
    return Rig((front, back), Imu(time_offset_s=1 / 3e3), "synthetic")


def pose(rng: np.random.Generator) -> Float:
    return se3(so3_exp(rng.normal(size=3)), rng.normal(size=3))


def covariance(rng: np.random.Generator, size: int = 6) -> Float:
    root = rng.normal(size=(size, size))
    return 1e-4 * (root @ root.T + np.eye(size))


def landmarks(rng: np.random.Generator, count: int = 7, descriptor_bytes: int = 32) -> Landmarks:
    return Landmarks(
        pair=rng.integers(0, 2, count),
        track_id=rng.integers(0, 2**62, count),
        points_body=rng.normal(size=(count, 3)),
        covariances=np.array([covariance(rng, 3) for _ in range(count)]).reshape(-1, 3, 3),
        left_px=rng.uniform(0, 60, (count, 2)),
        right_px=rng.uniform(0, 60, (count, 2)),
        descriptors=rng.integers(0, 256, (count, descriptor_bytes), dtype=np.uint8),
    )


def keyframe(number: int, epoch: int = 0, points: int = 7, images: bool = True) -> Keyframe:
    rng = np.random.default_rng(number)
    is_first = number == 0

    def image() -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
        return rng.integers(0, 256, (SIZE_PX[1], SIZE_PX[0]), dtype=np.uint8)

    return Keyframe(
        id=number,
        epoch=epoch,
        stamp_ns=START_NS + number * 333_333_333,
        status=list(Status)[number % 4],
        odom_T_body=pose(rng),
        covariance=covariance(rng),
        previous_id=None if is_first else number - 1,
        previous_T_body=None if is_first else pose(rng),
        relative_covariance=None if is_first else covariance(rng),
        landmarks=landmarks(rng, points),
        images={0: (image(), image()), 1: (image(), image())} if images else {},
    )


def estimate(number: int, epoch: int = 0) -> Estimate:
    rng = np.random.default_rng(number)
    return Estimate(
        stamp_ns=START_NS + number * 50_000_000,
        status=Status.TRACKING,
        nav_T_body=pose(rng),
        covariance=covariance(rng),
        epoch=epoch,
        velocity_nav=rng.normal(size=3),
        gyro_bias=rng.normal(size=3),
        accel_bias=rng.normal(size=3),
        velocity_covariance=covariance(rng, 3),
        gyro_bias_covariance=covariance(rng, 3),
        accel_bias_covariance=covariance(rng, 3),
        gravity_nav=rng.normal(size=3),
        gravity_covariance=covariance(rng, 3),
        tilt_covariance=covariance(rng, 2),
        time_offset_s=1 / 300,
        time_offset_sigma_s=1e-4 / 3,
        vision=Quality.WEAK,
        vision_reason="few points: Δ = 3 px",
        is_stationary=True,
    )


def prediction(number: int, epoch: int = 0) -> Prediction:
    rng = np.random.default_rng(number)
    return Prediction(START_NS + number * 5_000_000, pose(rng), rng.normal(size=3), rng.normal(size=3), epoch)


class SyntheticOdometry:
    """A `graphvio.slam.interface.Served` that refuses corrections of more than ten metres."""

    def __init__(self, max_bytes: int = 2**26) -> None:
        self.rig = rig()
        self.estimates: Broadcast[Estimate] = Broadcast()
        self.predictions: Broadcast[Prediction] = Broadcast()
        self.events: Broadcast[Event] = Broadcast()
        self.keyframe_log = KeyframeLog(max_bytes)
        self.map_T_odom: Float | None = None
        self.corrections: list[tuple[int, Float, Float]] = []
        self.figures: dict[str, float | int | str | None] = {}

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        self.corrections.append((keyframe_id, map_T_body, covariance))
        if np.linalg.norm(map_T_body[:3, 3]) > 10.0:
            return CorrectionResult(False, "off by 9 sigma", 81.25, 22.46, self.map_T_odom)
        self.map_T_odom = map_T_body
        return CorrectionResult(True, "", None, 22.46, self.map_T_odom)

    def status(self) -> Mapping[str, float | int | str | None]:
        return self.figures

    def end(self) -> None:
        for each in (self.estimates, self.predictions, self.events, self.keyframe_log):
            each.close()

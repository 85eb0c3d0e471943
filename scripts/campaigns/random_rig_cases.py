"""Rigs that are sampled at random: pairs and single cameras with any lens, place and direction, and their IMUs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.cameras import distort
from graphvio.geometry import se3, so3_exp
from graphvio.rig import Camera, Imu, Rig, SingleCamera, StereoPair
from graphvio.simulation.default_rig import rotation_zyx

SCENES = ("room", "corridor", "stairs", "calibration")
_SIZES_PX = ((320, 240), (512, 512), (640, 400), (640, 480), (752, 480))
_RATES_HZ = (8.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0)
_MAX_READOUT_US = 33e3
MAX_BEGIN_S = 5.0
_IMU_RATES_HZ = (100.0, 200.0, 400.0)
_LENSES = {
    "radial-tangential": ([-0.28, 0.07, 2e-4, 2e-5], 100.0),
    "equidistant": ([0.0034, 0.0007, -0.0020, 0.0002], 150.0),
    "rational": ([0.3, -0.05, 3e-4, -2e-4, 0.01, 0.4, -0.03, 0.02], 100.0),
    "double-sphere": ([-0.2, 0.6], 150.0),
    "extended-unified": ([0.6, 1.1], 150.0),
    "omnidirectional": ([0.7, -0.1, 0.05, 3e-4, -2e-4], 120.0),
}
"""Model -> coefficients, and the widest angle across the image's diagonal that is sampled with them, degrees."""
_CAM_R_VEHICLE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # vehicle: forward, right, down


@dataclass(frozen=True, eq=False)
class RandomRig:
    """A rig, and what it is carried through.

    Attributes:
        rig: true cameras and IMU.
        scene: of the simulator.
        rate_hz: framesets per second.
        trigger_offset_ms: of each pair after the one before; 0 where all are triggered together.
        begin_s: instant of the walk at which the odometry begins: at 0 s it stands still.
    """

    rig: Rig
    scene: str
    rate_hz: float
    trigger_offset_ms: float
    begin_s: float

    @property
    def summary(self) -> str:
        """A line about it."""
        pairs = [f"{pair.left.model} {100 * pair.baseline_m:.0f} cm" for pair in self.rig.pairs]
        singles = [f"{single.left.model} single" for single in self.rig.singles]
        begin = f" from {self.begin_s:.1f} s" if self.begin_s else ""
        offset = f", {self.trigger_offset_ms:.0f} ms apart" if self.trigger_offset_ms else ""
        camera = self.rig.cameras[0]
        readout = f", readout {1e-6 * camera.readout_ns:.0f} ms" if camera.readout_ns else ""
        size = "{}x{}".format(*camera.size_px)
        how = f"{self.scene}{begin}, {self.rate_hz:g} Hz{offset}{readout}, {size}"
        return f"{how}: {'; '.join([*pairs, *singles])}"


def sample_rig(seed: int) -> RandomRig:
    """Sample one; the same seed gives the same."""
    random = np.random.default_rng(np.random.SeedSequence([seed, 27]))
    size_px = _SIZES_PX[random.integers(len(_SIZES_PX))]
    pair_count = int(random.choice([0, 1, 2, 3], p=[0.2, 0.4, 0.3, 0.1]))
    single_count = int(random.choice([0, 1, 2], p=[0.6, 0.25, 0.15])) if pair_count else int(random.integers(1, 5))
    pairs, singles = [], []
    model = str(random.choice(list(_LENSES)))
    for j in range(pair_count):
        if random.random() < 0.3:
            model = str(random.choice(list(_LENSES)))
        body_T_left = _place(random)
        left = _camera(f"cam{2 * j}", model, size_px, random, body_T_left)
        baseline_m = np.exp(random.uniform(np.log(0.03), np.log(0.25)))
        left_T_right = se3(
            so3_exp(np.deg2rad(random.normal(0.0, 0.4, 3))), np.array([baseline_m, *random.normal(0.0, 0.001, 2)])
        )
        right = _camera(f"cam{2 * j + 1}", model, size_px, random, body_T_left @ left_T_right, like=left)
        pairs.append(StereoPair(f"pair{j}", left, right))
    for k in range(2 * pair_count, 2 * pair_count + single_count):
        singles.append(SingleCamera(_camera(f"cam{k}", model, size_px, random, _place(random))))
    noise = float(np.exp(random.uniform(0.0, np.log(8.0))))
    imu = Imu()
    imu = replace(
        imu,
        rate_hz=float(random.choice(_IMU_RATES_HZ)),
        gyro_noise_density=noise * imu.gyro_noise_density,
        accel_noise_density=noise * imu.accel_noise_density,
    )
    rate_hz = float(random.choice(_RATES_HZ))
    is_apart = pair_count > 1 and random.random() < 0.3
    scene = SCENES[random.integers(len(SCENES))]
    trigger_offset_ms = float(random.uniform(5.0, 500.0 / rate_hz)) if is_apart else 0.0
    rig = Rig(tuple(pairs), imu, name=f"random-{seed}", singles=tuple(singles))
    if random.random() < 0.3:
        readout_us = random.uniform(0.2, 0.95) * min(1e6 / rate_hz, _MAX_READOUT_US)
        rig = rig.with_cameras(lambda camera: replace(camera, line_time_us=readout_us / camera.size_px[1]))
    begin_s = float(random.uniform(1.5, MAX_BEGIN_S)) if random.random() < 0.5 else 0.0
    return RandomRig(rig, scene, rate_hz, trigger_offset_ms, begin_s)


def _place(random: np.random.Generator) -> Float:
    """Sample the pose of a camera in body: any yaw, mostly the right way up, within 30 cm of the IMU."""
    yaw, pitch, roll = random.uniform(-np.pi, np.pi), random.normal(0.2, 0.2), random.normal(0.0, 0.1)
    if random.random() < 0.15:
        roll += float(random.choice([-0.5, 0.5, 1.0])) * np.pi  # on its side, or upside down
    body_R_vehicle = rotation_zyx(yaw, pitch, roll) @ np.diag([1.0, -1.0, -1.0])
    return se3(np.ascontiguousarray(body_R_vehicle @ _CAM_R_VEHICLE.T), random.uniform(-0.3, 0.3, 3))


def _camera(
    name: str,
    model: str,
    size_px: tuple[int, int],
    random: np.random.Generator,
    body_T_cam: Float,
    like: Camera | None = None,
) -> Camera:
    """Sample a camera; the right one of a pair nearly has the left one's intrinsics."""
    coefficients, widest_deg = _LENSES[model]
    unit = Camera(name, model, size_px, np.array([100.0, 100.0, 0.0, 0.0]), np.array(coefficients), body_T_cam)
    if like is not None:
        focal_px = like.intrinsics[0] * (1.0 + random.normal(0.0, 0.003))
    else:
        edge = np.tan(0.5 * np.deg2rad(random.uniform(60.0, widest_deg)))
        distorted, *_ = distort(unit.model_number, unit.distortion, edge, 0.0)
        focal_px = 0.5 * float(np.hypot(*size_px)) / distorted
    centre_px = 0.5 * (np.array(size_px) - 1.0) + random.normal(0.0, 3.0, 2)
    intrinsics = np.array([focal_px, focal_px * (1.0 + random.normal(0.0, 0.001)), *centre_px])
    return replace(unit, intrinsics=intrinsics)

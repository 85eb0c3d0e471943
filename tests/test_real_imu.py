"""The smoother on a real IMU, with motions of vision that are sampled from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from recordings import REAL_DATA

from graphvio.arrays import Float
from graphvio.backend.inertial import ImuBuffer
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import InitialUncertainty, RigState, origin_covariance
from graphvio.config.stages import SmootherConfig
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Imu
from graphvio.sources.faults import FaultLog
from graphvio.sources.tables import read_imu_csv
from graphvio.trajectory_files import load_trajectory

FOLDER = REAL_DATA / "euroc_v101_imu" / "mav0"
STEP_NS, STEPS = 50_000_000, 800
SIGMAS = np.repeat([5e-4, 1e-3], 3)  # of vision: rad and metres from frame to frame
TILT_SIGMA, SPEED_SIGMA, GYRO_BIAS_SIGMA = 0.05, 0.2, 0.1
BIAS_AIM = 2e-3  # rad/s


@dataclass(frozen=True, eq=False)
class Beginning:
    """The first 40 s of EuRoC V1_01, in steps of 50 ms.

    Attributes:
        stamps_ns: N of them.
        intervals: N - 1, the IMU from each stamp to the next.
        world_T_body: (N, 4, 4) as the file has it.
        gyro_bias: (N, 3) rad/s, the same.
    """

    stamps_ns: list[int]
    intervals: list[ImuInterval]
    world_T_body: Float
    gyro_bias: Float

    @staticmethod
    def read(more_bias: Float) -> Beginning:
        """Read it, and add so much (3,) rad/s to what the gyro measured."""
        path = FOLDER / "state_groundtruth_estimate0" / "data.csv"
        truth = load_trajectory(path)
        stamps = truth.stamps_ns[0] + np.arange(STEPS + 1) * STEP_NS
        poses, known = truth.at(stamps, 0.05)
        assert known.all()
        nearest = np.searchsorted(truth.stamps_ns, stamps)
        gyro_bias = np.loadtxt(path, delimiter=",", usecols=range(11, 14))[nearest]
        table = read_imu_csv(FOLDER / "imu0" / "data.csv", FaultLog("euroc_v101_imu"))
        buffer = ImuBuffer(50.0)
        for stamp_ns, values in zip(table.stamps_ns.tolist(), table.values, strict=True):
            if not buffer.covers(int(stamps[-1])):
                assert buffer.add(ImuSample(stamp_ns, values[:3] + more_bias, values[3:])) == ""
        intervals = [buffer.interval(*each) for each in zip(stamps[:-1].tolist(), stamps[1:].tolist(), strict=True)]
        whole = [interval for interval in intervals if interval is not None]
        assert len(whole) == STEPS
        return Beginning(stamps.tolist(), whole, poses.nav_T_body, gyro_bias + more_bias)

    def started(self, rng: np.random.Generator) -> Smoother:
        """A smoother initialised at the file's pose and at a standstill up to errors, with unknown biases."""
        pose = self.world_T_body[0]
        covariance = origin_covariance(pose[:3, :3], TILT_SIGMA)
        off = np.linalg.cholesky(covariance) @ rng.standard_normal(6)
        velocity = SPEED_SIGMA * rng.standard_normal(3)
        smoother = Smoother(SmootherConfig(), Imu())
        smoother.initialise(
            self.stamps_ns[0],
            RigState(pose @ se3_exp(off), velocity, np.zeros(3), np.zeros(3)),
            InitialUncertainty(covariance, SPEED_SIGMA, GYRO_BIAS_SIGMA),
        )
        return smoother

    def motion(self, k: int, rng: np.random.Generator) -> RelativeMotion:
        """From one step to the next, as vision would see it."""
        moved = se3_inverse(self.world_T_body[k - 1]) @ self.world_T_body[k] @ se3_exp(SIGMAS * rng.standard_normal(6))
        stamps = self.stamps_ns
        return RelativeMotion(stamps[k - 1], stamps[k], moved, np.diag(SIGMAS**2), np.zeros((6, 6)), 100)


@pytest.mark.skipif(not FOLDER.is_dir(), reason="needs ../shared/data/euroc_v101_imu")
@pytest.mark.parametrize("more_bias", [np.zeros(3), np.array([0.06, -0.09, -0.04])], ids=["as it is", "other bias"])
def test_the_gyros_bias_is_found(more_bias: Float) -> None:
    """The file's orientations are turned against the IMU's by some degrees, so they say nothing of tilt or forces."""
    rng, flight = np.random.default_rng(0), Beginning.read(more_bias)
    smoother, refused, errors = flight.started(rng), 0, []
    for k in range(1, STEPS + 1):
        smoother.extend(flight.stamps_ns[k], flight.intervals[k - 1])
        motion = flight.motion(k, rng)
        if smoother.gate(motion).accepted:
            smoother.add_motion(motion)
        else:
            refused += 1
        smoother.update({flight.stamps_ns[k]})
        errors.append(smoother.state().gyro_bias - flight.gyro_bias[k])
    assert np.abs(flight.gyro_bias).max(axis=0).min() > BIAS_AIM  # so that zero, the start, would not do
    assert np.abs(errors[STEPS // 2 :]).max() < BIAS_AIM
    assert refused < 0.02 * STEPS

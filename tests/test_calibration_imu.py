"""Cameras against the IMU, from rotations."""

import numpy as np
import pytest
from hand_eye import FRAMES, PERIOD_NS, Walk, motions, straight, turning

from graphvio.arrays import Float, Int
from graphvio.calibration.imu_alignment import ImuAlignment, align
from graphvio.calibration.segments import all_segments
from graphvio.errors import CalibrationError
from graphvio.geometry import so3_exp, so3_log
from graphvio.rig import Imu

BODY_R_LEFT = so3_exp(np.array([1.2, -1.2, 1.2]))
BIAS = np.array([0.01, -0.02, 0.005])
RATE_HZ = 200.0


def gyro(walk: Walk, offset_s: float, rng: np.random.Generator, noise: float) -> tuple[Int, Float]:
    """Stamps and readings of a gyro on the walk, on a clock that is ahead by an offset."""
    times = np.arange(-1.0, FRAMES * PERIOD_NS * 1e-9 + 1.0, 1.0 / RATE_HZ)
    h = 1e-4
    rates = []
    for time in times:
        back, ahead = walk(float(time - h))[:3, :3], walk(float(time + h))[:3, :3]
        rates.append(BODY_R_LEFT @ so3_log(np.ascontiguousarray(back.T @ ahead)) / (2.0 * h))
    measured = np.array(rates) + BIAS + noise * np.sqrt(RATE_HZ) * rng.standard_normal((len(times), 3))
    return ((times + offset_s) * 1e9).astype(np.int64) + 10**12, measured


def found(
    walk: Walk = turning,
    seed: int = 0,
    offset_s: float = 0.012,
    rig_R_left: Float = BODY_R_LEFT,
    rig_offset_s: float = 0.0,
) -> ImuAlignment:
    rng = np.random.default_rng(seed)
    camera, other = motions(walk, np.eye(4), rng), motions(walk, np.eye(4), rng)
    for each in (camera, other):
        each.stamps_ns += 10**12
        each._reference = {a + 10**12: b + 10**12 for a, b in each._reference.items()}
        each._edge = {a + 10**12: edge for a, edge in each._edge.items()}
    segments = all_segments(camera.stamps_ns.tolist(), [camera.between, other.between])
    imu = Imu(time_offset_s=rig_offset_s)
    stamps, rates = gyro(walk, offset_s, rng, imu.gyro_noise_density)
    return align(segments, 0, stamps, rates, imu, rig_R_left)


def test_align_walk_finds_rotation_offset_bias() -> None:
    for seed in range(2):
        each = found(seed=seed)
        off = so3_log(np.ascontiguousarray(each.body_R_left @ BODY_R_LEFT.T))
        sigmas = np.sqrt(np.diag(each.covariance))
        assert np.all(np.abs(off) < 4.0 * sigmas)
        assert sigmas.max() < 3e-3
        assert abs(each.time_offset_s - 0.012) < 4.0 * each.time_offset_sigma_s
        assert each.time_offset_sigma_s < 2e-3
        np.testing.assert_allclose(each.gyro_bias, BIAS, atol=2e-3)
        assert not each.is_turned
        assert each.is_late  # the rig says 0


def test_align_right_rig_has_no_warnings() -> None:
    each = found(rig_offset_s=0.012)
    assert each.warnings("front") == []


@pytest.mark.parametrize("degrees", [2.0, 90.0])
def test_align_wrong_rotation_warns_with_size(degrees: float) -> None:
    wrong = so3_exp(np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8])) @ BODY_R_LEFT
    each = found(rig_R_left=wrong)
    assert each.is_turned
    assert np.rad2deg(np.linalg.norm(each.misrotation)) == pytest.approx(degrees, abs=0.2)
    off = so3_log(np.ascontiguousarray(each.body_R_left @ BODY_R_LEFT.T))
    assert np.linalg.norm(off) < 5e-3
    assert "front is turned by" in each.warnings("front")[0]


def test_align_without_rotation_raises() -> None:
    with pytest.raises(CalibrationError, match="one axis only, or hardly at all"):
        found(straight)


def test_align_no_overlap_raises() -> None:
    rng = np.random.default_rng(1)
    camera = motions(turning, np.eye(4), rng)
    segments = all_segments(camera.stamps_ns.tolist(), [camera.between, camera.between])
    stamps, rates = gyro(turning, 0.0, rng, 1e-4)
    with pytest.raises(CalibrationError, match="in common"):
        align(segments, 0, stamps + 10**13, rates, Imu(), BODY_R_LEFT)

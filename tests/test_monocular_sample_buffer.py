from dataclasses import replace

import numpy as np
import pytest

from graphvio.config import Config
from graphvio.config.stages import TimingConfig
from graphvio.monocular.sample_buffer import SampleBuffer
from graphvio.rig import Imu

MS = 1_000_000
SMOOTHER = Config().smoother


def filled(stamps_ms: list[int]) -> SampleBuffer:
    buffer = SampleBuffer(Imu(), replace(Config(), timing=TimingConfig(max_imu_gap_ms=20.0)))
    for stamp_ms in stamps_ms:
        buffer.add(stamp_ms * MS, np.full(6, float(stamp_ms)))
    return buffer


def test_collect_uses_samples_in_time_order_up_to_the_first_one_after_a_stamp() -> None:
    buffer = filled([0, 10, 30, 20, 40, 50])
    buffer.collect(0, 35 * MS)
    samples = buffer.between(np.array([0, 35 * MS]), is_offset_known=True)
    assert samples.stamps_ns.tolist() == [0, 10 * MS, 20 * MS, 30 * MS, 40 * MS]
    assert samples.readings[:, 0].tolist() == [0.0, 10.0, 20.0, 30.0, 40.0]
    buffer.collect(0, 45 * MS)
    assert buffer.between(np.array([0, 45 * MS]), is_offset_known=True).stamps_ns[-1] == 50 * MS


def test_collect_forgets_what_is_older_than_what_is_needed() -> None:
    buffer = filled(list(range(0, 1000, 10)))
    buffer.collect(500 * MS, 900 * MS)
    assert 380 * MS <= buffer.between(np.array([500 * MS, 900 * MS]), is_offset_known=True).stamps_ns[0] <= 400 * MS


def test_missing_samples_are_covered_where_they_are_bridged() -> None:
    buffer = filled([0, 10, 20, 30, 60, 70])
    buffer.collect(0, 70 * MS)
    assert buffer.covers(0, 30 * MS, bridges=False)
    for start_ms, end_ms in ((20, 65), (60, 80)):
        assert not buffer.covers(start_ms * MS, end_ms * MS, bridges=False)
        assert buffer.covers(start_ms * MS, end_ms * MS)
    assert not buffer.covers(60 * MS, 5_200 * MS)  # beyond what can be bridged
    assert not buffer.covers(-10 * MS, 20 * MS)


@pytest.mark.parametrize("gap_ms", [21, 1_000, 4_990, 5_000, 5_010, 5_029, 5_030, 5_031, 5_100])
def test_gap_is_not_covered_or_has_the_noise_of_one(gap_ms: int) -> None:
    buffer = filled([0, 10, 10 + gap_ms, 20 + gap_ms])
    buffer.collect(0, (20 + gap_ms) * MS)
    states_ns = np.array([5, 15 + gap_ms]) * MS
    is_covered = buffer.covers(*states_ns.tolist())
    assert is_covered == (gap_ms <= 5_030)
    if is_covered:
        samples = buffer.between(states_ns, is_offset_known=True)
        assert (samples.noise_factors[samples.stamps_ns == 10 * MS] > 1e3).all()


@pytest.mark.parametrize("offset_ms", [-8, 8])
def test_gap_is_divided_at_the_states_by_the_clock_of_the_samples(offset_ms: int) -> None:
    buffer = filled([0, 10, 20, 30, 90, 100])
    buffer.time_offset_s = 1e-3 * offset_ms
    buffer.collect(0, 100 * MS)
    samples = buffer.between(np.array([20, 60, 130]) * MS, is_offset_known=True)
    assert (60 + offset_ms) * MS in samples.stamps_ns
    assert samples.stamps_ns[-1] >= (130 + offset_ms) * MS
    assert buffer.covers(20 * MS, 130 * MS)


def test_noise_of_missing_samples_is_that_of_motion_that_is_not_measured() -> None:
    buffer = filled([0, 10, 20, 30, 90, 100])
    buffer.collect(0, 100 * MS)
    samples = buffer.between(np.array([20, 50, 120]) * MS, is_offset_known=True)
    assert samples.stamps_ns.tolist() == [ms * MS for ms in (0, 10, 20, 30, 50, 90, 100, 120, 150)]
    # Interpolated over the gap, divided at the state in it; the newest reading is held.
    np.testing.assert_allclose(samples.readings[:, 0], [0, 10, 20, 30, 50, 90, 100, 100, 100])
    assert (samples.noise_factors[[0, 1, 2, 5]] == 1.0).all()
    sigmas = np.sqrt(samples.noise_factors - 1.0) * samples.noise_densities
    by_rates = np.array([0.06 * np.sqrt(0.02), 0.06 * np.sqrt(0.04)]) * SMOOTHER.motion_angular_accel_sigma_rad_s2
    np.testing.assert_allclose(sigmas[3:5, 0], by_rates)  # the rate changes in all of the gap
    np.testing.assert_allclose(sigmas[3:5, 1], np.sqrt([0.02, 0.04]) * SMOOTHER.motion_accel_sigma_m_s2)
    np.testing.assert_allclose(sigmas[6, 1], np.sqrt(0.02) * SMOOTHER.motion_accel_sigma_m_s2)


def test_newest_reading_lasts_longer_where_the_time_offset_is_not_known() -> None:
    buffer = filled(list(range(0, 50, 10)))
    buffer.collect(0, 40 * MS)
    assert buffer.between(np.array([0, 40 * MS]), is_offset_known=True).stamps_ns[-1] == 40 * MS
    held = buffer.between(np.array([0, 40 * MS]), is_offset_known=False)
    assert held.stamps_ns[-1] > 50 * MS
    np.testing.assert_array_equal(held.readings[-1], held.readings[-2])
    assert not buffer.covers(0, 45 * MS, bridges=False)

import numpy as np

from graphvio.monocular.sample_buffer import SampleBuffer
from graphvio.rig import Imu

MS = 1_000_000


def filled(stamps_ms: list[int]) -> SampleBuffer:
    buffer = SampleBuffer(Imu(), 1.0, 20 * MS)
    for stamp_ms in stamps_ms:
        buffer.add(stamp_ms * MS, np.full(6, float(stamp_ms)))
    return buffer


def test_collect_uses_samples_in_time_order_up_to_the_first_one_after_a_stamp() -> None:
    buffer = filled([0, 10, 30, 20, 40, 50])
    buffer.collect(0, 35 * MS)
    samples = buffer.between(np.array([0, 35 * MS]), is_offset_known=True)
    assert samples.stamps_ns.tolist() == [0, 10 * MS, 20 * MS, 30 * MS, 40 * MS]
    assert samples.readings[:, 0].tolist() == [0.0, 10.0, 20.0, 30.0, 40.0]
    assert buffer.reaches(40 * MS)
    assert not buffer.reaches(41 * MS)
    buffer.collect(0, 45 * MS)
    assert buffer.reaches(50 * MS)


def test_collect_forgets_what_is_older_than_what_is_needed() -> None:
    buffer = filled(list(range(0, 1000, 10)))
    buffer.collect(500 * MS, 900 * MS)
    assert 380 * MS <= buffer.between(np.array([500 * MS, 900 * MS]), is_offset_known=True).stamps_ns[0] <= 400 * MS


def test_covers_is_false_across_a_gap() -> None:
    buffer = filled([0, 10, 20, 30, 60, 70])
    buffer.collect(0, 70 * MS)
    assert buffer.covers(0, 30 * MS)
    assert not buffer.covers(20 * MS, 65 * MS)


def test_newest_reading_lasts_longer_where_the_time_offset_is_not_known() -> None:
    buffer = filled(list(range(0, 50, 10)))
    buffer.collect(0, 40 * MS)
    assert buffer.between(np.array([0, 40 * MS]), is_offset_known=True).stamps_ns[-1] == 40 * MS
    held = buffer.between(np.array([0, 40 * MS]), is_offset_known=False)
    assert held.stamps_ns[-1] > 50 * MS
    np.testing.assert_array_equal(held.readings[-1], held.readings[-2])
    assert not buffer.covers(0, 45 * MS)

"""What is given up where time does not suffice, and what never is: load, queues, and the order of samples."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphvio.live import estimation
from graphvio.live.estimation import FRAMESETS, Inbox, make_inbox
from graphvio.live.figures import Meter
from graphvio.live.load import LoadControl
from graphvio.live.reception import SampleOrder
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement

SOON_S = 20.0  # until then a thread is waited for; only a test that fails takes so long
PERIOD_NS = 50_000_000
LIMIT_MS = 100.0
SHARES = [1.0, 0.7, 0.5, 0.35]


def in_thread(work: Callable[[], object]) -> tuple[threading.Thread, list[object]]:
    results: list[object] = []
    thread = threading.Thread(target=lambda: results.append(work()), daemon=True)
    thread.start()
    return thread, results


def sample(stamp_ns: int) -> ImuSample:
    return ImuSample(stamp_ns, np.zeros(3), np.zeros(3))


def frameset(stamp_ns: int) -> FrameSet:
    return FrameSet(stamp_ns, {})


# ---------------------------------------------------------------- corners and framesets


def worked(control: LoadControl, framesets: int, work_ms: float, waited_ms: float = 0.0, first: int = 0) -> list[float]:
    """Shares after each of so many framesets at 20 Hz."""
    shares = []
    for i in range(first, first + framesets):
        control.add(i * PERIOD_NS, waited_ms, work_ms)
        shares.append(control.corner_share)
    return shares


def test_load_control_with_time_left_gives_up_nothing() -> None:
    control = LoadControl(LIMIT_MS)
    assert set(worked(control, 500, work_ms=30.0)) == {1.0}
    assert not control.must_skip(20.0, is_newest=False)


def test_load_control_lowers_corners_stepwise_before_delay() -> None:
    control = LoadControl(LIMIT_MS)
    shares = worked(control, 200, work_ms=48.0)
    assert [share for i, share in enumerate(shares) if i == 0 or share != shares[i - 1]] == SHARES
    assert not control.must_skip(50.0, is_newest=False)  # 48 + 50 is less than 100


def test_load_control_lowers_corners_instead_of_skipping() -> None:
    control = LoadControl(LIMIT_MS)
    worked(control, 3, work_ms=60.0)
    before = control.corner_share
    assert not control.must_skip(70.0, is_newest=False)
    assert control.corner_share < before


def test_load_control_skips_late_frameset_for_newer_one() -> None:
    control = LoadControl(LIMIT_MS)
    assert control.must_skip(LIMIT_MS + 1.0, is_newest=False)
    assert not control.must_skip(10.0 * LIMIT_MS, is_newest=True)


def test_load_control_raises_corners_after_two_idle_seconds() -> None:
    control = LoadControl(LIMIT_MS)
    worked(control, 200, work_ms=48.0)
    assert control.corner_share == SHARES[-1]
    shares = worked(control, 1000, work_ms=5.0, first=200)
    assert set(shares[:40]) == {SHARES[-1]}
    assert shares[-1] == 1.0
    assert shares == sorted(shares)


def test_load_control_medium_work_changes_nothing() -> None:
    control = LoadControl(LIMIT_MS)
    worked(control, 200, work_ms=48.0)
    assert set(worked(control, 1000, work_ms=35.0, first=200)) == {SHARES[-1]}


moments = st.tuples(
    st.booleans(),  # is it a question, or a frameset that was worked on?
    st.integers(1, 500_000_000),  # since the last stamp, ns
    st.floats(0.0, 500.0),  # waited, ms
    st.floats(0.1, 500.0),  # work, ms
    st.booleans(),  # newest
)


@given(st.lists(moments, max_size=200))
def test_load_control_never_skips_newest_and_lowers_corners_first(
    history: list[tuple[bool, int, float, float, bool]],
) -> None:
    control, stamp_ns = LoadControl(LIMIT_MS), 0
    for is_question, step_ns, waited_ms, work_ms, is_newest in history:
        before = control.corner_share
        stamp_ns += step_ns
        if is_question:
            if control.must_skip(waited_ms, is_newest):
                assert not is_newest
                assert before == SHARES[-1] or waited_ms > LIMIT_MS
            assert control.corner_share <= before
        else:
            control.add(stamp_ns, waited_ms, work_ms)
        assert control.corner_share in SHARES
        assert abs(SHARES.index(control.corner_share) - SHARES.index(before)) <= 1


# ---------------------------------------------------------------- what waits for the odometry


def put(inbox: Inbox, measurement: Measurement, arrival_ns: int = 0) -> None:
    inbox.put((measurement, arrival_ns), FRAMESETS if isinstance(measurement, FrameSet) else "")


def taken(inbox: Inbox) -> list[int]:
    stamps = []
    while (item := inbox.get(0.0)) is not None:
        stamps.append(item[0].stamp_ns)
    return stamps


def test_inbox_drops_oldest_frameset_and_keeps_samples() -> None:
    inbox = make_inbox(2, is_realtime=True)
    for i in range(4):
        put(inbox, sample(10 * i))
        put(inbox, frameset(10 * i + 5))
    assert (inbox.waiting(FRAMESETS), len(inbox), inbox.dropped(FRAMESETS)) == (2, 6, 2)
    assert taken(inbox) == [0, 10, 20, 25, 30, 35]
    assert (inbox.waiting(FRAMESETS), inbox.dropped()) == (0, 0)


@given(st.lists(st.booleans(), max_size=60), st.integers(1, 5), st.integers(1, 9))
def test_inbox_loses_no_sample_and_counts_dropped_framesets(
    are_framesets: list[bool], most: int, taken_every: int
) -> None:
    inbox = make_inbox(most, is_realtime=True)
    came: list[int] = []
    for i, is_frameset in enumerate(are_framesets):
        put(inbox, frameset(i) if is_frameset else sample(i))
        if i % taken_every == 0 and (item := inbox.get(0.0)) is not None:
            came.append(item[0].stamp_ns)
        assert inbox.waiting(FRAMESETS) <= most
    came += taken(inbox)
    assert came == sorted(came)
    assert {i for i in came if not are_framesets[i]} == {i for i, each in enumerate(are_framesets) if not each}
    assert sum(are_framesets[i] for i in came) + inbox.dropped(FRAMESETS) == sum(are_framesets)
    if came and inbox.dropped(FRAMESETS) and are_framesets[-1]:
        assert came[-1] == len(are_framesets) - 1  # never the newest


def test_inbox_keeps_arrival() -> None:
    inbox = make_inbox(1, is_realtime=True)
    put(inbox, sample(1), arrival_ns=77)
    assert inbox.get(0.0) is not None
    put(inbox, frameset(2), arrival_ns=78)
    item = inbox.get(0.0)
    assert item is not None
    assert item[1] == 78


def test_inbox_that_waits_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither framesets nor samples, however slowly they are taken."""
    monkeypatch.setattr(estimation, "_WAITING_SAMPLES", 5)
    inbox = make_inbox(2, is_realtime=False)

    def bring() -> None:
        for i in range(300):
            put(inbox, frameset(i) if i % 7 == 0 else sample(i))
        inbox.close()

    thread, _ = in_thread(bring)
    came = []
    while not inbox.is_finished:
        assert len(inbox) <= 7
        assert inbox.waiting(FRAMESETS) <= 2
        item = inbox.get(0.01)
        came += [] if item is None else [item[0].stamp_ns]
    thread.join(SOON_S)
    assert came == list(range(300))
    assert inbox.dropped(FRAMESETS) == inbox.dropped() == 0


def test_inbox_full_of_samples_counts_dropped_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimation, "_WAITING_SAMPLES", 5)
    inbox = make_inbox(2, is_realtime=True)
    for i in range(9):
        put(inbox, sample(i))
    assert (taken(inbox), inbox.dropped()) == ([0, 1, 2, 3, 4], 4)


@pytest.mark.parametrize("measurement", [frameset(1), sample(1)], ids=["frameset", "sample"])
def test_inbox_abandon_releases_waiting_writer(
    measurement: FrameSet | ImuSample, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimation, "_WAITING_SAMPLES", 1)
    inbox = make_inbox(1, is_realtime=False)
    put(inbox, frameset(0))
    put(inbox, sample(0))
    thread, _ = in_thread(lambda: put(inbox, measurement))
    inbox.abandon()
    thread.join(SOON_S)
    assert not thread.is_alive()
    put(inbox, frameset(2))
    assert (len(inbox), inbox.waiting(FRAMESETS), inbox.is_finished) == (0, 0, True)


# ---------------------------------------------------------------- samples that overtake


def order_of(
    stamps: list[int], max_wait_ms: float = 10.0, rate_hz: float = 200.0
) -> tuple[list[int], SampleOrder, list[int]]:
    """Stamps as they go on, and how many are held after each came."""
    order = SampleOrder(max_wait_ms, rate_hz)
    given_out: list[int] = []
    held = []
    for i, stamp in enumerate(stamps):
        given_out += [each.stamp_ns for each in order.add(sample(stamp))]
        held.append(i + 1 - len(given_out))
    return given_out, order, held


@given(st.integers(0, 2**31), st.integers(2, 80), st.sampled_from([2_500_000, 5_000_000, 10_000_000]))
def test_sample_order_sorts_overtaking_samples(seed: int, count: int, period_ns: int) -> None:
    """Each comes up to two and a half periods late: no more than is waited for."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(count, dtype=np.int64) * period_ns
    lateness = np.where(np.arange(count) < 3, 0.0, rng.uniform(0.0, 2.4 * period_ns, count))
    came = stamps[np.argsort(stamps + lateness, kind="stable")].tolist()
    given_out, order, _ = order_of(came, max_wait_ms=3e-6 * period_ns, rate_hz=1e9 / period_ns)
    given_out += [each.stamp_ns for each in order.flush()]
    assert given_out == stamps.tolist()


@given(st.lists(st.integers(0, 200), max_size=100))
def test_sample_order_loses_and_repeats_none(ticks: list[int]) -> None:
    stamps = [5_000_000 * tick for tick in ticks]
    given_out, order, _ = order_of(stamps)
    given_out += [each.stamp_ns for each in order.flush()]
    assert sorted(given_out) == sorted(stamps)
    assert order.flush() == []


@given(st.lists(st.integers(-1_000_000, 1_000_000), min_size=1, max_size=100))
def test_sample_order_without_gap_holds_nothing(jitter_ns: list[int]) -> None:
    stamps = [5_000_000 * i + off for i, off in enumerate(jitter_ns)]
    given_out, _, held = order_of(stamps)
    assert given_out == stamps
    assert set(held) == {0}


def test_sample_order_lost_sample_wait_is_bounded() -> None:
    stamps = [5_000_000 * i for i in range(20) if i != 10]
    given_out, _, held = order_of(stamps)
    assert given_out == stamps
    assert max(held) == 2  # the next two; with the third, 10 ms are over
    assert held[-1] == 0


def test_sample_order_passes_late_sample_on() -> None:
    stamps = [5_000_000 * i for i in range(20)]
    given_out, _, held = order_of([*stamps, stamps[3]])
    assert given_out == [*stamps, stamps[3]]
    assert held[-1] == 0


# ---------------------------------------------------------------- figures


def test_meter_latency_percentiles_of_whole_run() -> None:
    meter = Meter()
    assert meter.recent_latency_ms(50) is meter.latency_ms(99) is None
    for latency_ms in [*([10.2] * 990), *([300.0] * 10)]:
        meter.add_latency(latency_ms)
    assert meter.recent_latency_ms(50) == pytest.approx(10.2)
    assert meter.latency_ms(98) == pytest.approx(10.5)
    assert meter.latency_ms(99.5) == pytest.approx(300.0)  # never more than the longest
    assert meter.max_latency_ms == 300.0


def test_meter_latency_outside_histogram() -> None:
    meter = Meter()
    meter.add_latency(-3.0)
    assert meter.latency_ms(99) == 0.0
    for _ in range(9):
        meter.add_latency(7000.0)
    assert meter.latency_ms(99) == 7000.0


def test_meter_rate_is_of_last_two_seconds() -> None:
    meter = Meter()
    for i in range(100):
        meter.add_arrival("estimates", i * PERIOD_NS)
    assert meter.rate_hz("estimates", 99 * PERIOD_NS) == pytest.approx(20.0)
    assert meter.rate_hz("estimates", 99 * PERIOD_NS + 3_000_000_000) == 0.0
    assert meter.rate_hz("imu_samples", 0) == 0.0
    meter.count("skipped_late", 3)
    assert meter.counts == {"estimates": 100, "skipped_late": 3}

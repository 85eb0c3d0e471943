"""Stamps of devices on the host's clock: accuracy, smoothness, and clocks that restart."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import pytest
import synthetic  # noqa: F401  (hypothesis' settings)
from device_messages import Conditions, Messages, clock_errors, drift_ppm, synthetic_messages
from hypothesis import given
from hypothesis import strategies as st

from graphvio.arrays import Float, Int
from graphvio.live.clocks import ClockMap, ClockMaps, SharedClock
from graphvio.live.envelope import Envelope

MS = 1_000_000
S = 1_000_000_000


@dataclass
class Run:
    """Mapped messages; implausible ones have no entry in ``mapped`` and ``kept``."""

    mapped: list[int] = field(default_factory=list)
    kept: list[int] = field(default_factory=list)
    reports: Counter[str] = field(default_factory=Counter)
    drift_ppm: float = 0.0


def feed(messages: Messages) -> Run:
    run = Run()

    def report(stamp_ns: int, kind: str, detail: str) -> None:
        assert "clock synthetic" in detail
        run.reports[kind] += 1

    clock = ClockMap("synthetic", report)
    for k, (stamp, arrival) in enumerate(zip(messages.stamps_ns.tolist(), messages.arrivals_ns.tolist(), strict=True)):
        at = clock.map(stamp, arrival)
        if at is not None:
            run.mapped.append(at)
            run.kept.append(k)
    run.drift_ppm = drift_ppm(clock)
    return run


def messages_of(duration_s: float = 10.0, seed: int = 0, begin_s: float = 0.0, **conditions: float) -> Messages:
    return synthetic_messages(Conditions(**conditions), duration_s, np.random.default_rng(seed), begin_s)


def joined(*parts: Messages) -> Messages:
    columns = (np.concatenate([getattr(p, name) for p in parts]) for name in ("stamps_ns", "arrivals_ns", "truth_ns"))
    return Messages(*columns)


def errors_us(run: Run, messages: Messages) -> Float:
    return np.asarray(1e-3 * (np.array(run.mapped) - messages.truth_ns[run.kept]))


def rates(run: Run, messages: Messages) -> tuple[Float, Int]:
    """Seconds of the host per second of the device from message to message, and the stamps at their ends."""
    stamps = messages.stamps_ns[run.kept]
    return np.diff(np.array(run.mapped)) / np.diff(stamps), stamps[1:] - stamps[0]


def assert_smooth(run: Run, messages: Messages) -> None:
    """Time goes forward at a rate within the estimated drift and the slew; rounding is 1 ns."""
    assert (np.diff(np.array(run.mapped)) > 0).all()
    rate, at = rates(run, messages)
    step_ns = np.diff(messages.stamps_ns[run.kept])
    bound = np.where(at - step_ns < S, 0.5, 1e-3) + 1e-3 + 2.0 / step_ns  # slew, and drifts of up to 1000 ppm
    assert (np.abs(rate - 1.0) <= bound).all()


# ------------------------------------------------------------------ accuracy


@pytest.mark.parametrize("drift_ppm", [-200.0, 0.0, 200.0])
@pytest.mark.parametrize(
    ("rate_hz", "at_5_s", "at_10_s", "ppm"), [(200.0, 150.0, 50.0, 10.0), (30.0, 500.0, 250.0, 30.0)]
)
def test_clock_map_error_is_far_below_jitter(
    drift_ppm: float, rate_hz: float, at_5_s: float, at_10_s: float, ppm: float
) -> None:
    """Jitter of 2 ms, 1 % of the messages 50 ms late; bounds in microseconds are of the largest error of six runs."""
    five, ten, thirty = clock_errors(Conditions(drift_ppm, rate_hz=rate_hz), (5.0, 10.0, 30.0), runs=6)
    assert five.max_us < at_5_s
    assert ten.max_us < at_10_s
    assert ten.drift_ppm < ppm
    assert thirty.max_us < 100.0
    assert thirty.drift_ppm < 3.0


def test_clock_map_before_drift_estimate_error_is_accumulated_drift() -> None:
    (one,) = clock_errors(Conditions(200.0), (1.0,), runs=6)
    assert one.max_us < 600.0


def test_clock_map_polled_bus_error_is_bounded() -> None:
    """Delays spread evenly over 8 ms, as of a slow USB device; there is no density of small ones."""
    messages = messages_of(30.0, drift_ppm=-80.0, jitter_ms=0.0, outlier_share=0.0)
    rng = np.random.default_rng(1)
    arrivals = np.maximum.accumulate(messages.truth_ns + rng.integers(0, 8 * MS, len(messages.truth_ns)))
    run = feed(replace_arrivals(messages, arrivals))
    assert np.abs(errors_us(run, messages)[2000:]).max() < 200.0
    assert run.drift_ppm == pytest.approx(-80.0, abs=5.0)


def test_clock_map_warming_crystal_is_followed() -> None:
    """From 20 to 10 ppm within two minutes."""
    at_s = np.arange(0.0, 120.0, 0.01)
    wander_ns = 1e3 * (20.0 * at_s - 5.0 * at_s**2 / 120.0)
    stamps = np.round(1e9 * at_s - wander_ns).astype(np.int64)
    truth = np.round(1e9 * at_s).astype(np.int64)
    arrivals = truth + np.round(1e6 * np.random.default_rng(2).exponential(2.0, len(at_s))).astype(np.int64)
    messages = Messages(stamps, arrivals, truth)
    run = feed(messages)
    assert np.abs(errors_us(run, messages)[1000:]).max() < 250.0
    assert run.drift_ppm == pytest.approx(12.0, abs=3.0)  # of the last minute


def replace_arrivals(messages: Messages, arrivals_ns: Int) -> Messages:
    return Messages(messages.stamps_ns, arrivals_ns, messages.truth_ns)


# ------------------------------------------------------------------ smoothness


@pytest.mark.parametrize("drift_ppm", [-200.0, 30.0, 200.0])
@pytest.mark.parametrize("jitter_ms", [0.2, 5.0, 20.0])
def test_clock_map_is_smooth(drift_ppm: float, jitter_ms: float) -> None:
    messages = messages_of(40.0, drift_ppm=drift_ppm, jitter_ms=jitter_ms)
    run = feed(messages)
    assert len(run.kept) == len(messages.stamps_ns)
    assert not run.reports
    assert_smooth(run, messages)


@given(
    delays=st.lists(st.integers(0, 450_000), min_size=2, max_size=120),
    steps=st.lists(st.integers(1, 400_000), min_size=120, max_size=120),
)
def test_clock_map_any_delays_is_monotonic(delays: list[int], steps: list[int]) -> None:
    """Microseconds; messages that overtake each other included, and pauses of up to 0.4 s."""
    stamps = 1000 * np.cumsum(steps[: len(delays)], dtype=np.int64)
    arrivals = 7 * S + stamps + 1000 * np.array(delays, dtype=np.int64)
    messages = Messages(stamps, arrivals, stamps)
    run = feed(messages)
    assert len(run.kept) == len(stamps)
    assert_smooth(run, messages)
    assert feed(messages).mapped == run.mapped


@given(
    delays=st.lists(st.integers(0, 450_000), min_size=2, max_size=120),
    steps=st.lists(st.integers(1, 50_000), min_size=120, max_size=120),
)
def test_clock_map_overtaking_messages_keep_order(delays: list[int], steps: list[int]) -> None:
    """They are mapped in the order in which they come; an older stamp is never mapped to a later time."""
    stamps = 1000 * np.cumsum(steps[: len(delays)], dtype=np.int64)
    arrivals = 7 * S + stamps + 1000 * np.array(delays, dtype=np.int64)
    order = np.argsort(arrivals, kind="stable")
    run = feed(Messages(stamps[order], arrivals[order], stamps[order]))
    by_stamp = np.argsort(stamps[order][run.kept])
    assert (np.diff(np.array(run.mapped)[by_stamp]) > 0).all()


def test_clock_map_is_shared_by_sensors_of_device() -> None:
    """Images come 40 ms later than samples of the same stamp, and are mapped to the same time."""
    samples = messages_of(8.0, drift_ppm=150.0, rate_hz=200.0)
    queue = [(int(a), int(s), "imu") for a, s in zip(samples.arrivals_ns, samples.stamps_ns, strict=True)]
    queue += [(arrival + 40 * MS, stamp, "camera") for arrival, stamp, _ in queue[::10]]
    clock = ClockMap("synthetic", lambda *_: None)
    mapped: dict[str, dict[int, int | None]] = {"imu": {}, "camera": {}}
    for arrival, stamp, sensor in sorted(queue):
        mapped[sensor][stamp] = clock.map(stamp, arrival)
    assert len(mapped["camera"]) == 160
    for stamp, at in mapped["camera"].items():
        assert at == mapped["imu"][stamp]


def test_clock_map_initial_backlog_is_corrected_within_a_second() -> None:
    """Messages of the first 0.3 s come at once, 0.3 s late."""
    messages = messages_of(3.0, outlier_share=0.0)
    arrivals = np.maximum(messages.arrivals_ns, messages.truth_ns[0] + 300 * MS)
    run = feed(replace_arrivals(messages, arrivals))
    errors = errors_us(run, messages)
    assert errors[0] == pytest.approx(3e5, rel=0.01)
    assert np.abs(errors[200:]).max() < 200.0
    assert_smooth(run, messages)


def test_clock_map_small_step_is_followed_slowly() -> None:
    messages = messages_of(30.0)
    stamps = messages.stamps_ns + np.where(np.arange(len(messages.stamps_ns)) >= 2000, 12 * MS, 0)
    run = feed(Messages(stamps, messages.arrivals_ns, messages.truth_ns))
    errors = errors_us(run, messages)
    assert run.reports == {"clock_stepped": 1}
    assert errors[2000] == pytest.approx(12e3, abs=100.0)
    assert np.abs(errors[2000 + round(12.5 * 200) :]).max() < 200.0
    rate, _ = rates(run, Messages(stamps, messages.arrivals_ns, messages.truth_ns))
    assert np.abs(rate[200:] - 1.0).max() < 1.1e-3


def test_clock_map_silent_device_continues() -> None:
    """For ten minutes; its drift was known to a fraction of a ppm."""
    before = messages_of(60.0, seed=1, drift_ppm=150.0)
    later = messages_of(20.0, seed=2, begin_s=660.0, drift_ppm=150.0)
    after = Messages(later.stamps_ns + round(660 * S / 1.00015), later.arrivals_ns, later.truth_ns)
    run = feed(joined(before, after))
    assert not run.reports
    assert np.abs(errors_us(run, joined(before, after))[2000:]).max() < 300.0


def test_clock_map_busy_host_changes_nothing() -> None:
    """For ten seconds nothing comes less than 30 ms late."""
    messages = messages_of(60.0, drift_ppm=50.0)
    at_s = 1e-9 * (messages.truth_ns - messages.truth_ns[0])
    late = np.where((at_s > 30.0) & (at_s < 40.0), 30 * MS, 0)
    run = feed(replace_arrivals(messages, messages.arrivals_ns + late))
    assert np.abs(errors_us(run, messages)[2000:]).max() < 100.0


# ------------------------------------------------------------------ clocks that restart


@pytest.mark.parametrize("away_s", [0.0, 3.0, 600.0])
def test_clock_map_restarted_device_is_mapped_again(away_s: float) -> None:
    before = messages_of(20.0, seed=1, drift_ppm=120.0)
    after = messages_of(20.0, seed=2, begin_s=20.1 + away_s, drift_ppm=120.0)  # stamps from the start again
    messages = joined(before, after)
    run = feed(messages)
    assert run.reports["clock_restarted"] == 1
    lost = len(messages.stamps_ns) - len(run.kept)
    assert lost == run.reports["stamp_implausible"]
    assert 2 <= lost <= 20  # 50 ms, or what comes meanwhile
    assert (np.diff(np.array(run.mapped)) > 0).all()
    errors = errors_us(run, messages)
    assert np.abs(errors[-200:]).max() < 100.0
    second = np.flatnonzero(np.array(run.kept) >= 4000)
    assert np.abs(errors[second[200] :]).max() < 200.0  # the crystal is the same: its drift is known at once


def test_clock_maps_expected_restart_loses_no_message() -> None:
    reports: Counter[str] = Counter()
    maps = ClockMaps(lambda stamp_ns, kind, detail: reports.update([kind]))
    before, after = messages_of(5.0, seed=1), messages_of(5.0, seed=2, begin_s=8.0)
    mapped = []
    for part in (before, after):
        for stamp, arrival in zip(part.stamps_ns.tolist(), part.arrivals_ns.tolist(), strict=True):
            mapped.append(maps.map("synthetic", stamp, arrival))
        for name in ("synthetic", None, "unknown"):
            maps.expect_restart(name)
    assert None not in mapped
    assert reports == {"clock_restarted": 1}
    assert list(maps._maps) == ["synthetic"]


def test_clock_map_expected_restart_that_does_not_happen_changes_nothing() -> None:
    messages = messages_of(5.0)
    clock = ClockMap("synthetic", lambda *_: None)
    mapped = []
    for k, (stamp, arrival) in enumerate(zip(messages.stamps_ns.tolist(), messages.arrivals_ns.tolist(), strict=True)):
        if k == 500:
            clock.expect_restart()
        mapped.append(clock.map(stamp, arrival))
    assert mapped == feed(messages).mapped


@pytest.mark.parametrize("jump_ns", [-3600 * S, -800 * MS, 700 * MS, 3600 * S])
def test_clock_map_wild_stamp_is_left_out(jump_ns: int) -> None:
    messages = messages_of(5.0)
    stamps = messages.stamps_ns.copy()
    stamps[500] += jump_ns
    run = feed(Messages(stamps, messages.arrivals_ns, messages.truth_ns))
    assert run.reports == {"stamp_implausible": 1}
    assert run.kept == [k for k in range(1000) if k != 500]
    assert np.abs(errors_us(run, messages)[400:]).max() < 100.0


def test_clock_map_two_wild_stamps_are_left_out() -> None:
    messages = messages_of(10.0, rate_hz=10.0)
    stamps = messages.stamps_ns.copy()
    stamps[50:52] += 900 * S
    run = feed(Messages(stamps, messages.arrivals_ns, messages.truth_ns))
    assert run.reports == {"stamp_implausible": 2}


def test_clock_map_slightly_wild_stamp_affects_no_other() -> None:
    messages = messages_of(10.0)
    stamps = messages.stamps_ns.copy()
    stamps[1000] += 100 * MS
    run = feed(Messages(stamps, messages.arrivals_ns, messages.truth_ns))
    assert not run.reports
    assert np.abs(np.delete(errors_us(run, messages), 1000)[400:]).max() < 100.0


def test_clock_map_stuck_images_are_no_restart() -> None:
    """Five come within 10 ms, each 0.8 s late and with no sample of the IMU between them."""
    messages = messages_of(5.0, jitter_ms=0.01, outlier_share=0.0)
    at = np.r_[:600, np.arange(440, 465, 5), 600:1000]
    arrivals = np.sort(messages.arrivals_ns[np.r_[:600, [600] * 5, 600:1000]])
    arrivals[600:605] += np.arange(-5, 0) * MS // 2
    run = feed(Messages(messages.stamps_ns[at], np.maximum.accumulate(arrivals), messages.truth_ns[at]))
    assert run.reports == {"stamp_implausible": 5}
    assert len(run.kept) == 1000


def test_clock_map_restart_continues_after_all_mapped_times() -> None:
    """Even after a stamp that was 0.4 s ahead."""
    clock = ClockMap("synthetic", lambda *_: None)
    ahead = [clock.map(stamp, 7 * S + stamp) for stamp in (0, 100 * MS)] + [clock.map(600 * MS, 7 * S + 200 * MS)]
    clock.expect_restart()
    first = clock.map(3600 * S, 7 * S + 210 * MS)
    assert first is not None
    assert first > max(at for at in ahead if at is not None)


@pytest.mark.parametrize("jump_ns", [-3600 * S, -700 * MS, 700 * MS, 3600 * S])
def test_clock_map_set_clock_is_mapped_again(jump_ns: int) -> None:
    messages = messages_of(20.0)
    stamps = messages.stamps_ns + np.where(np.arange(4000) >= 2000, jump_ns, 0)
    run = feed(Messages(stamps, messages.arrivals_ns, messages.truth_ns))
    assert run.reports["clock_restarted"] == 1
    assert len(run.kept) >= 3980
    assert np.abs(errors_us(run, messages)[-1500:]).max() < 100.0
    assert (np.diff(np.array(run.mapped)) > 0).all()


@pytest.mark.parametrize("drain_s", [0.0, 0.4])
def test_clock_map_pause_of_host_is_no_restart(drain_s: float) -> None:
    """For 2 s nothing is read; then all comes at once, or in a while, and nothing is lost or moved."""
    messages = messages_of(10.0)
    held = (messages.truth_ns > messages.truth_ns[0] + 5 * S) & (messages.truth_ns < messages.truth_ns[0] + 7 * S)
    read = messages.truth_ns[0] + 7 * S + np.round(0.5 * drain_s * (messages.truth_ns - messages.truth_ns[held][0]))
    arrivals = np.where(held, read.astype(np.int64), messages.arrivals_ns)
    run = feed(replace_arrivals(messages, np.maximum.accumulate(arrivals)))
    assert not run.reports
    assert len(run.kept) == 2000
    assert np.abs(errors_us(run, messages)[400:]).max() < 100.0


def test_clock_map_stopped_clock_is_mapped_again() -> None:
    """A device that slept for 10 s, and whose stamps go on where they were."""
    before = messages_of(10.0, seed=1)
    after = messages_of(10.0, seed=2, begin_s=20.0)
    shifted = Messages(after.stamps_ns + 10 * S, after.arrivals_ns, after.truth_ns)
    run = feed(joined(before, shifted))
    assert run.reports == {"clock_restarted": 1}
    assert np.abs(errors_us(run, joined(before, shifted))[-1000:]).max() < 100.0


# ------------------------------------------------------------------ sensors that share a clock


class Shared:
    """Two sensors on one clock, and the events of it."""

    def __init__(self) -> None:
        self.events: Counter[str] = Counter()
        self.clock = SharedClock(lambda stamp_ns, kind, detail: self.events.update([kind]))

    def feed(self, start_ms: float, count: int, camera_lag_ms: float = 0.0) -> tuple[list[float], list[float]]:
        """Stamps in ms of an IMU (5 ms) and a camera (50 ms) whose images come later; as they are to be used."""
        messages = [(5.0 * k, "imu", start_ms + 5.0 * k) for k in range(count)]
        messages += [(50.0 * k + camera_lag_ms, "cam0", start_ms + 50.0 * k) for k in range(count // 10)]
        used: dict[str, list[float]] = {"imu": [], "cam0": []}
        for _, sensor, stamp_ms in sorted(messages):
            mapped = self.clock.map(sensor, round(1e6 * stamp_ms))
            if mapped is not None:
                used[sensor].append(1e-6 * mapped)
        return used["imu"], used["cam0"]


def test_shared_clock_keeps_stamps() -> None:
    run = Shared()
    imu, cam0 = run.feed(1000.0, 200, camera_lag_ms=180.0)
    np.testing.assert_allclose(imu, 1000.0 + 5.0 * np.arange(200))
    np.testing.assert_allclose(cam0, 1000.0 + 50.0 * np.arange(20))
    assert not run.events


@pytest.mark.parametrize("back_ms", [400.0, 3000.0, 3600e3])
@pytest.mark.parametrize("lag_ms", [0.0, 60.0])
def test_shared_clock_set_back_adds_same_offset_to_all_sensors(back_ms: float, lag_ms: float) -> None:
    run = Shared()
    imu, cam0 = run.feed(10_000.0, 1000, lag_ms)
    end_ms = imu[-1]
    imu, cam0 = run.feed(15_000.0 - back_ms, 400, lag_ms)
    assert run.events["clock_restarted"] == 1
    assert imu[0] == pytest.approx(end_ms + 4000.0, abs=10.0)
    np.testing.assert_allclose(np.diff(imu), 5.0)
    late = [each for each in cam0 if each < end_ms + 3000.0]
    assert len(late) <= 2  # as they are, late, and left out by what comes next
    shift = imu[-1] - (15_000.0 - back_ms + 5.0 * 399)
    expected = 15_000.0 - back_ms + 50.0 * np.arange(40) + shift
    np.testing.assert_allclose(cam0[len(late) :], expected[len(late) - len(cam0) :])


def test_shared_clock_wild_stamps_and_disorder_change_nothing() -> None:
    run = Shared()
    run.feed(0.0, 100)
    for stamp_ms in (505.0, 60_000.0, 510.0, 480.0, 515.0, -60_000.0, 520.0, 525.0):
        run.clock.map("imu", round(1e6 * stamp_ms))
    imu, _ = run.feed(530.0, 100)
    np.testing.assert_allclose(imu, 530.0 + 5.0 * np.arange(100))
    assert run.events == {"stamp_implausible": 1}


# ------------------------------------------------------------------ the line under the delays


@given(
    delays=st.lists(st.integers(0, 3_000_000), min_size=5, max_size=60),
    drift_ppm=st.integers(-300, 300),
)
def test_envelope_line_is_supporting_line_at_mean_time(delays: list[int], drift_ppm: int) -> None:
    envelope = Envelope()
    points = [(k * S, delay + drift_ppm * k * 1000) for k, delay in enumerate(delays)]  # a window each
    for point in points:
        envelope.add(*point)
    heights = [delay - envelope.line.at(time) for time, delay in points[:-1]]  # the last window is open
    assert min(heights) == pytest.approx(0.0, abs=1e-3)
    centre = float(np.mean([time for time, _ in points[:-1]]))
    for drift in np.linspace(-1e-3, 1e-3, 101):  # no other line below them is higher in the middle
        at_zero = min(delay - drift * time for time, delay in points[:-1])
        assert at_zero + drift * centre <= envelope.line.at(centre) + 1e-3


def test_envelope_without_jitter_is_exact() -> None:
    envelope = Envelope()
    for k in range(10):
        envelope.add(k * S, 1000 - 50_000 * k)
    assert envelope.line.drift == pytest.approx(-50e-6, rel=1e-12)
    assert envelope.line.at(0) == pytest.approx(1000.0)

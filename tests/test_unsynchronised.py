"""Pairs that are not triggered together: framesets of their own, at their instants, as accurate a trajectory."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import START_NS, frame_stamps, half_size_rig, noise_image, small_rig, write_euroc, write_rows
from rendered import rendered_once

from graphvio import Estimate, FrameSet, ImuSample, Odometry, Status, open_source
from graphvio.config import Config
from graphvio.errors import SourceError
from graphvio.evaluation import evaluate
from graphvio.measurements.events import Event, EventKind
from graphvio.measurements.sensors import Measurement
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig
from graphvio.simulation import Simulator, build_scene, write_recording
from graphvio.sources.matching import TOLERANCE_NS, PairIndex, group_pairs, match_sides
from graphvio.sources.sequencer import merge
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

MS = 1_000_000
DURATION_S = 3.0
CONFIG = Config()


def small_simulator(
    rate_hz: float | Sequence[float] = 20.0, trigger_offset_ms: float = 0.0, duration_s: float = DURATION_S
) -> Simulator:
    """A walk through the room with the paper's rig and images of 320x240."""
    scene = build_scene("room", duration_s, 0.5)
    return Simulator(scene, half_size_rig(), 3, rate_hz, trigger_offset_ms=trigger_offset_ms)


# ------------------------------------------------------------------ the simulator


def test_staggered_pairs_are_imaged_at_their_own_instants() -> None:
    """10 Hz with an offset of 50 ms shows by turns what 20 Hz shows at once."""
    staggered = small_simulator(10.0, 50.0, duration_s=0.5)
    together = small_simulator(20.0, duration_s=0.5)
    assert staggered.stamps_ns.tolist() == together.stamps_ns.tolist()
    for index in range(4):
        frameset = staggered.frameset(index, noisy=False)
        assert list(frameset.images) == [index % 2]
        for mine, theirs in zip(
            frameset.images[index % 2], together.frameset(index, noisy=False).images[index % 2], strict=True
        ):
            np.testing.assert_array_equal(mine, theirs)


def test_each_pair_has_its_rate() -> None:
    simulator = small_simulator((20.0, 15.0), duration_s=1.0)
    assert [len(simulator.triggers_ns(pair)) for pair in (0, 1)] == [20, 15]
    assert len(simulator.stamps_ns) == 30  # five instants are shared
    both = [i for i in range(30) if simulator.triggered(i) == (0, 1)]
    assert np.diff(simulator.stamps_ns[both]).tolist() == [200 * MS] * 4


@pytest.mark.parametrize(
    ("rates", "offset_ms"), [((20.0, 0.0), 0.0), ((), 0.0), (20.0, -1.0), (20.0, float("nan")), (20.0, 2000.0)]
)
def test_impossible_triggers_are_refused(rates: float | Sequence[float], offset_ms: float) -> None:
    with pytest.raises(SourceError):
        small_simulator(rates, offset_ms)


# ------------------------------------------------------------------ sources


@pytest.mark.parametrize(
    ("rates", "offset_ms", "count", "shared"),
    [(20.0, 17.0, 20, 0), ((20.0, 15.0), 0.0, 14, 3), (20.0, 3.0, 20, 0), (20.0, 1.5, 10, 10)],
)
def test_stamps_are_kept_and_nothing_is_lost(
    tmp_path: Path, rates: float | Sequence[float], offset_ms: float, count: int, shared: int
) -> None:
    simulator = small_simulator(rates, offset_ms, duration_s=0.5)
    write_recording(simulator, tmp_path / "walk")
    source = open_source(tmp_path / "walk")
    latest_imu, stamps = 0, []
    seen: dict[int, list[int]] = {0: [], 1: []}
    for measurement in source:
        if isinstance(measurement, ImuSample):
            latest_imu = measurement.stamp_ns
            continue
        stamps.append(measurement.stamp_ns)
        assert latest_imu >= min(measurement.stamp_ns, int(simulator.imu_track.stamps_ns[-1]))
        for pair in measurement.images:
            seen[pair].append(measurement.stamp_ns)
    assert source.frameset_count == len(stamps) == count
    assert (np.diff(stamps) > 0).all()
    assert sum(stamp in seen[0] for stamp in seen[1]) == shared
    assert source.faults.counts == {}
    assert seen[0] == simulator.triggers_ns(0).tolist()
    joined = offset_ms * MS <= TOLERANCE_NS
    assert seen[1] == (simulator.triggers_ns(1) - (round(offset_ms * MS) if joined else 0)).tolist()


@given(
    offsets=st.lists(st.integers(0, 25 * MS), min_size=2, max_size=4),
    periods=st.lists(st.integers(20 * MS, 70 * MS), min_size=4, max_size=4),
    tolerance_ns=st.integers(0, 5 * MS),
    close=st.booleans(),
)
def test_framesets_hold_only_what_is_of_their_instant(
    offsets: list[int], periods: list[int], tolerance_ns: int, close: bool
) -> None:
    if close:  # around the tolerance, where chains of pairs are ambiguous
        offsets, periods = [offset % (3 * MS) for offset in offsets], [periods[0]] * 4
    pairs: list[PairIndex] = []
    for offset, period in zip(offsets, periods, strict=False):
        stamps = START_NS + offset + period * np.arange(12, dtype=np.int64)
        pairs.append(match_sides(stamps, stamps))
    index = group_pairs(pairs, tolerance_ns)
    assert (np.diff(index.stamps_ns) > tolerance_ns).all()
    for number, pair in enumerate(pairs):
        rows = index.rows[:, number, 0]
        assert rows[rows >= 0].tolist() == list(range(12))  # each image once, in order
        own = pair.stamps_ns[rows[rows >= 0]]
        assert np.abs(own - index.stamps_ns[rows >= 0]).max() <= tolerance_ns


def test_a_right_image_belongs_to_the_nearest_left_one() -> None:
    index = match_sides(np.array([0, 8, 50]) * MS, np.array([7, 51, 53]) * MS, 9 * MS)
    assert index.rows.tolist() == [[1, 0], [2, 1]]
    assert index.stamps_ns.tolist() == [8 * MS, 50 * MS]
    assert (index.left_alone.tolist(), index.right_alone.tolist()) == ([0], [53 * MS])


def test_pair_images_beyond_the_tolerance_are_not_joined(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    shifted = [f"{s + 3 * MS},{s}.png" for s in frame_stamps(10)]
    write_rows(tmp_path / "mav0/cam3/data.csv", shifted)
    source = open_source(tmp_path, tolerance_ms=2.0)
    assert all(list(measurement.images) == [0] for measurement in source if isinstance(measurement, FrameSet))
    assert source.faults.counts["unpaired_image"] == 19  # the last right image comes after the last frameset
    assert "cam3 has none within 2 ms" in next(i.detail for i in source.faults.events if i.kind == "unpaired_image")
    wider = open_source(tmp_path, tolerance_ms=3.0)
    assert [list(measurement.images) for measurement in wider if isinstance(measurement, FrameSet)] == [[0, 1]] * 10
    assert wider.faults.counts == {}


def test_stamps_of_arrival_are_joined_and_the_left_one_counts(tmp_path: Path) -> None:
    """Left and right images were triggered together, and came up to 6.8 ms apart, as those of KITTI's raw drives."""
    write_euroc(tmp_path, pairs=1, frames=20)
    late = np.random.default_rng(3).uniform(-6.8, 6.8, 20)
    late[4], late[9] = 6.8, -6.8
    stamps = [s + round(ms * MS) for s, ms in zip(frame_stamps(20), late, strict=True)]
    write_rows(tmp_path / "mav0/cam1/data.csv", [f"{a},{b}.png" for a, b in zip(stamps, frame_stamps(20), strict=True)])
    dropped = open_source(tmp_path, tolerance_ms=2.0)
    assert dropped.frameset_count == np.sum(np.abs(late) <= 2.0) < 20
    source = open_source(tmp_path)
    assert source.stamps_ns.tolist() == frame_stamps(20)
    for number, frameset in enumerate(each for each in source if isinstance(each, FrameSet)):
        np.testing.assert_array_equal(frameset.images[0][1], noise_image(100 + number))
    assert source.faults.counts == {}


def test_images_with_several_partners_are_counted_and_the_nearest_taken(tmp_path: Path) -> None:
    write_euroc(tmp_path, pairs=1, frames=10)
    right = [(s, s) for s in frame_stamps(10)]
    right.insert(5, (frame_stamps(10)[4] + 10 * MS, frame_stamps(10)[0]))  # an image too many
    write_rows(tmp_path / "mav0/cam1/data.csv", [f"{stamp},{file}.png" for stamp, file in right])
    source = open_source(tmp_path)
    for number, frameset in enumerate(each for each in source if isinstance(each, FrameSet)):
        np.testing.assert_array_equal(frameset.images[0][1], noise_image(100 + number))
    assert source.faults.counts == {"pairing_ambiguous": 1, "unpaired_image": 1}
    (event,) = [each for each in source.faults.events if each.kind == "pairing_ambiguous"]
    assert event.detail == f"pair0 has several images within 16.7 ms of {frame_stamps(10)[4]}; the nearest are taken"


def test_a_missing_image_is_not_replaced_by_its_neighbour() -> None:
    stamps = np.arange(10) * 100 * MS
    index = match_sides(stamps, np.delete(stamps, 4) + 5 * MS)
    assert index.left_alone.tolist() == [400 * MS]
    assert index.stamps_ns.tolist() == np.delete(stamps, 4).tolist()
    assert not len(index.ambiguous)


@pytest.mark.parametrize("tolerance_ms", [-0.1, 11.0, float("nan"), float("inf")])
def test_tolerances_that_make_no_sense_are_refused(tmp_path: Path, tolerance_ms: float) -> None:
    write_euroc(tmp_path, frames=2)
    with pytest.raises(SourceError, match="tolerance_ms"):
        open_source(tmp_path, tolerance_ms=tolerance_ms)


def test_a_tolerance_of_zero_joins_equal_stamps_only(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    for camera in ("cam2", "cam3"):
        write_rows(tmp_path / "mav0" / camera / "data.csv", [f"{s + MS},{s}.png" for s in frame_stamps(10)])
    assert open_source(tmp_path).frameset_count == 10
    assert open_source(tmp_path, tolerance_ms=0.0).frameset_count == 20


def test_only_what_is_missing_is_a_fault(tmp_path: Path) -> None:
    """Another trigger is none; a pair that ends early is."""
    write_euroc(tmp_path)
    for camera in ("cam2", "cam3"):
        rows = [f"{s + 20 * MS},{s}.png" for s in frame_stamps(10)]
        write_rows(tmp_path / "mav0" / camera / "data.csv", rows[:6])
    source = open_source(tmp_path)
    assert source.frameset_count == 16
    assert source.faults.counts == {"frameset_incomplete": 3}
    assert source.faults.events[0].stamp_ns == START_NS + 7 * 50 * MS


# ------------------------------------------------------------------ live framesets


def images_of(*pairs: int) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    blank = np.zeros((2, 2), dtype=np.uint8)
    return dict.fromkeys(pairs, (blank, blank))


@pytest.mark.parametrize(
    ("first", "second", "apart_us", "framesets", "kinds"),
    [
        ((0,), (1,), 300, [[0, 1]], []),
        ((0,), (1,), 0, [[0, 1]], []),
        ((1,), (0,), 300, [[0, 1]], []),
        ((0,), (1,), -300, [[0, 1]], []),
        ((0,), (1,), 1000, [[0], [1]], []),
        ((0, 1), (1,), 300, [[0, 1]], ["frameset_duplicate_stamp"]),
        ((0,), (7,), 300, [[0]], ["frameset_duplicate_stamp"]),
        ((0,), (1,), -3000, [[0]], ["frameset_backward_stamp"]),
    ],
)
def test_pairs_of_one_instant_that_come_separately_are_joined_while_held(
    first: tuple[int, ...], second: tuple[int, ...], apart_us: int, framesets: list[list[int]], kinds: list[str]
) -> None:
    reported: list[str] = []
    synchroniser = Synchroniser(small_rig(2), Config(), lambda _, kind, __: reported.append(kind))
    synchroniser.add_frameset(FrameSet(START_NS, images_of(*first)))
    synchroniser.add_frameset(FrameSet(START_NS + 1000 * apart_us, images_of(*second)))
    held: list[FrameSet] = []
    while (frameset := synchroniser.next_held()) is not None:
        held.append(frameset)
    assert [sorted(frameset.images) for frameset in held] == framesets
    assert held[0].stamp_ns == START_NS
    assert reported == kinds


# ------------------------------------------------------------------ the odometry


@cache
def walk(
    rates: float | tuple[float, ...], offset_ms: float, duration_s: float = DURATION_S
) -> tuple[Rig, list[FrameSet], list[ImuSample], Trajectory]:
    def write(folder: Path) -> None:
        write_recording(small_simulator(rates, offset_ms, duration_s), folder)

    source = open_source(rendered_once("unsynchronised", write, rates, offset_ms, duration_s))
    assert source.truth is not None
    measurements = list(source)
    framesets = [each for each in measurements if isinstance(each, FrameSet)]
    samples = [each for each in measurements if isinstance(each, ImuSample)]
    return source.rig, framesets, samples, load_trajectory(source.truth)


def feed(rig: Rig, measurements: Iterable[Measurement]) -> Iterator[Estimate]:
    odometry = Odometry(rig, CONFIG)
    for measurement in measurements:
        estimate = odometry.process(measurement)
        if estimate is not None:
            yield estimate
    yield from odometry.finish()


@cache
def estimates_of(rates: float | tuple[float, ...], offset_ms: float, imu: bool) -> tuple[list[Estimate], float]:
    """The estimates of a walk, and the rmse of their positions, metres."""
    rig, framesets, samples, truth = walk(rates, offset_ms)
    if not imu:
        rig, samples = rig.without_imu(), []
    estimates = list(feed(rig, merge(samples, framesets)))
    posed = [e for e in estimates if e.nav_T_body is not None]
    made = Trajectory(np.array([e.stamp_ns for e in posed]), np.array([e.nav_T_body for e in posed]))
    return estimates, evaluate(made, truth).ate_position_m.rmse


@pytest.mark.parametrize("imu", [True, False], ids=["imu", "no-imu"])
@pytest.mark.parametrize(
    ("rates", "offset_ms"),
    [(20.0, 17.0), (20.0, 3.0), ((20.0, 15.0), 0.0)],
    ids=["17 ms", "3 ms", "15 Hz"],
)
def test_staggered_pairs_are_as_accurate_as_synchronised_ones(
    rates: float | tuple[float, ...], offset_ms: float, imu: bool
) -> None:
    """Each frameset has an estimate at its own stamp, within 1.5 times the synchronised error and 2 mm."""
    _, together = estimates_of(20.0, 0.0, imu)
    _, framesets, _, _ = walk(rates, offset_ms)
    estimates, apart = estimates_of(rates, offset_ms, imu)
    assert [e.stamp_ns for e in estimates] == [f.stamp_ns for f in framesets]
    assert [sorted(e.pairs) for e in estimates] == [sorted(f.images) for f in framesets]
    assert all(e.nav_T_body is not None and e.epoch == 0 for e in estimates)
    first_of_back = next(i for i, f in enumerate(framesets) if 1 in f.images)
    moved = [e.status for i, e in enumerate(estimates) if i not in (0, first_of_back)]
    assert sum(status is not Status.TRACKING for status in moved) <= 1  # one motion in 10 000 is gated by chance
    assert apart < 1.5 * together + 0.002
    assert apart < 0.010


@pytest.mark.parametrize("imu", [True, False], ids=["imu", "no-imu"])
def test_staggered_pairs_are_both_used(imu: bool) -> None:
    estimates, _ = estimates_of(20.0, 17.0, imu)
    for pair in (0, 1):
        reports = [e.pairs[pair] for e in estimates[2:] if pair in e.pairs]
        assert len(reports) >= 59
        assert np.median([report.inliers for report in reports]) > 20


def test_a_late_pair_at_a_low_rate_breaks_nothing_without_an_imu() -> None:
    """The first images of the second pair come 50 ms after the start, when the speed is not yet known."""
    estimates, error = estimates_of(10.0, 50.0, False)
    assert {e.epoch for e in estimates} == {0}
    assert all(e.nav_T_body is not None for e in estimates[2:])
    assert error < 0.010


# ------------------------------------------------------------------ clocks that differ

CLOCKS_S = 7.0
CORRECTED_S = 4.0  # the walk has turned for two seconds by then


@cache
def run_with_late_stamps(late_ms: float) -> tuple[Odometry, list[Estimate], list[Event], Trajectory]:
    """The second pair, 17 ms after the first, has stamps that are late, by its clock or its way to the computer."""
    rig, framesets, samples, truth = walk(20.0, 17.0, CLOCKS_S)
    late = [
        FrameSet(each.stamp_ns + round(late_ms * MS), each.images) if 1 in each.images else each for each in framesets
    ]
    late.sort(key=lambda each: each.stamp_ns)
    odometry = Odometry(rig, CONFIG)
    estimates = [e for m in merge(samples, late) if (e := odometry.process(m)) is not None]
    estimates += odometry.finish()
    return odometry, estimates, odometry.take_events(), truth


def corrected(estimates: Sequence[Estimate]) -> list[Estimate]:
    return [e for e in estimates if e.stamp_ns - estimates[0].stamp_ns > CORRECTED_S * 1e9]


def rmse_of(estimates: Sequence[Estimate], truth: Trajectory) -> float:
    posed = [e for e in estimates if e.nav_T_body is not None]
    made = Trajectory(np.array([e.stamp_ns for e in posed]), np.array([e.nav_T_body for e in posed]))
    return evaluate(made, truth).ate_position_m.rmse


@pytest.mark.parametrize("late_ms", [-8.0, 15.0])
def test_late_stamps_of_a_pair_are_found_and_corrected(late_ms: float) -> None:
    """From then on all motions are used, and poses are those at the stamps, as right as with right stamps."""
    odometry, estimates, events, truth = run_with_late_stamps(late_ms)
    (event,) = [each for each in events if each.kind == EventKind.TIME_OFFSET_OFF]
    assert event.stamp_ns - estimates[0].stamp_ns < CORRECTED_S * 1e9
    (warning,) = odometry.rig_warnings
    added = re.search(r"back: .* add (-?[.0-9]+) to stamp_offset_s of its cameras", warning)
    assert added is not None
    assert 1e3 * float(added[1]) == pytest.approx(-late_ms, abs=2.0)
    assert all(e.status is Status.TRACKING for e in corrected(estimates))
    assert rmse_of(corrected(estimates), truth) < rmse_of(corrected(run_with_late_stamps(0.0)[1]), truth) + 0.001


def test_right_stamps_are_left_alone() -> None:
    odometry, estimates, events, _ = run_with_late_stamps(0.0)
    assert odometry.rig_warnings == []
    assert not [each for each in events if each.kind == EventKind.TIME_OFFSET_OFF]
    assert all(e.status is Status.TRACKING for e in estimates[2:])


def test_final_poses_of_late_stamps_are_those_at_the_stamps() -> None:
    odometry, estimates, _, truth = run_with_late_stamps(15.0)
    final = dict(odometry.take_smoothed())
    assert sorted(final) == [e.stamp_ns for e in estimates if e.nav_T_body is not None]
    of_late = [e.stamp_ns for e in corrected(estimates) if 1 in e.pairs]
    poses = Trajectory(np.array(of_late), np.array([final[stamp_ns] for stamp_ns in of_late]))
    assert evaluate(poses, truth).ate_position_m.rmse < 0.002

"""Properties of the sequencer, the matching of images, the cleaning of stamps and the tables' readers."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import noise_image, small_rig, write_image

from graphvio.image_decoding import ImageError, decode_grey
from graphvio.measurements.sensors import FrameSet, ImuSample
from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import ImageFiles, Index
from graphvio.sources.matching import TOLERANCE_NS, group_pairs, match_sides
from graphvio.sources.recording import Source
from graphvio.sources.sequencer import COVER_NS, merge
from graphvio.sources.tables import ImuTable, clean_stamps, decimal_ns, parse_stamp, read_imu_csv

MS = 1_000_000
increasing = st.lists(st.integers(1, 200), max_size=60).map(lambda steps: (np.cumsum(steps) * MS).tolist())


def imu_at(stamps: list[int]) -> list[ImuSample]:
    return [ImuSample(stamp, np.zeros(3), np.zeros(3)) for stamp in stamps]


@given(imu=increasing, frames=increasing, offset_ns=st.integers(-300 * MS, 300 * MS))
def test_merge_puts_covering_samples_before_framesets(imu: list[int], frames: list[int], offset_ns: int) -> None:
    measurements = list(merge(imu_at(imu), [FrameSet(stamp, {}) for stamp in frames], offset_ns))
    assert [e.stamp_ns for e in measurements if isinstance(e, ImuSample)] == imu  # nothing lost, nothing moved
    assert [e.stamp_ns for e in measurements if isinstance(e, FrameSet)] == frames
    seen: list[int] = []
    for measurement in measurements:
        if isinstance(measurement, ImuSample):
            seen.append(measurement.stamp_ns)
            continue
        instant = measurement.stamp_ns + offset_ns
        covering = next((stamp for stamp in imu if stamp >= instant), None)
        if covering is not None and covering <= instant + COVER_NS:
            assert covering in seen
        assert all(stamp in seen for stamp in imu if stamp < instant)
        assert all(stamp <= instant + COVER_NS for stamp in seen)


def test_merge_reads_one_sample_ahead() -> None:
    taken: list[int] = []

    def samples() -> Iterator[ImuSample]:
        for sample in imu_at([0, 10, 20, 30, 40]):
            taken.append(sample.stamp_ns)
            yield sample

    for measurement in merge(samples(), [FrameSet(15, {})]):
        if isinstance(measurement, FrameSet):
            break
    assert taken == [0, 10, 20, 30]  # the one that covers, and the one that is next


@given(st.lists(st.integers(0, 30), max_size=40))
def test_clean_stamps_drops_the_fewest_rows(values: list[int]) -> None:
    stamps = np.array(values, dtype=np.int64)
    faults = FaultLog("any")
    kept = clean_stamps(stamps, "imu", Path("x.csv"), faults)
    chosen = stamps[kept]
    assert (np.diff(chosen) > 0).all()
    assert sum(faults.counts.values()) == len(values) - len(chosen)
    longest: list[int] = []  # the textbook's quadratic solution
    for i, value in enumerate(values):
        longest.append(1 + max((longest[j] for j in range(i) if values[j] < value), default=0))
    assert len(chosen) == max(longest, default=0)


def test_clean_stamps_keeps_the_first_of_equal_ones() -> None:
    kept = clean_stamps(np.array([1, 2, 2, 2, 3]), "imu", Path("x.csv"), FaultLog("any"))
    assert kept.tolist() == [True, True, False, False, True]


@pytest.mark.parametrize("before", [100, 30])  # most rows are before, or after
def test_clean_stamps_names_the_row_where_a_clock_was_set_back(before: int) -> None:
    stamps = np.arange(130) * 50 * MS + 7_200_000 * MS
    stamps[before:] -= 3_600_000 * MS
    faults = FaultLog("any")
    assert clean_stamps(stamps, "frame", Path("x.csv"), faults).sum() == 100
    (event,) = faults.events
    assert f"as are 30: at data row {before + 1} the clock goes back by 3600.0 s" in event.detail  # but for the period


@pytest.mark.parametrize("late", [[40], [20, 60, 90], list(range(30, 35))])
def test_clean_stamps_names_no_clock_for_rows_that_are_out_of_order(late: list[int]) -> None:
    stamps = np.arange(130) * 50 * MS
    stamps[late] -= 2_000 * MS + MS
    faults = FaultLog("any")
    clean_stamps(stamps, "frame", Path("x.csv"), faults)
    assert faults.events[0].detail.endswith("is out of order; the row is dropped")


@given(
    steps=st.lists(st.integers(8, 60), min_size=1, max_size=30),
    jitter=st.lists(st.integers(-TOLERANCE_NS // 2, TOLERANCE_NS // 2), min_size=30, max_size=30),
    lost_left=st.sets(st.integers(0, 29)),
    lost_right=st.sets(st.integers(0, 29)),
)
def test_match_sides_finds_all_common_images(
    steps: list[int], jitter: list[int], lost_left: set[int], lost_right: set[int]
) -> None:
    truth = np.cumsum(steps) * MS
    left = [i for i in range(len(steps)) if i not in lost_left]
    right = [i for i in range(len(steps)) if i not in lost_right]
    left_ns = truth[left]
    right_ns = np.array([truth[i] + jitter[i] for i in right], dtype=np.int64)
    index = match_sides(left_ns, right_ns)
    common = sorted(set(left) & set(right))
    assert index.stamps_ns.tolist() == truth[common].tolist()
    assert [left[row] for row in index.rows[:, 0]] == common
    assert [right[row] for row in index.rows[:, 1]] == common
    assert len(index.left_alone) == len(left) - len(common)
    assert len(index.right_alone) == len(right) - len(common)


@given(
    steps=st.lists(st.integers(8, 60), min_size=1, max_size=30),
    lost=st.lists(st.sets(st.integers(0, 29)), min_size=3, max_size=3),
    delay_ns=st.lists(st.integers(0, TOLERANCE_NS), min_size=3, max_size=3),
)
def test_group_pairs_joins_all_instants(steps: list[int], lost: list[set[int]], delay_ns: list[int]) -> None:
    truth = np.cumsum(steps) * MS
    present = [[i for i in range(len(steps)) if i not in gone] for gone in lost]
    pairs = [match_sides(truth[i] + delay, truth[i] + delay) for i, delay in zip(present, delay_ns, strict=True)]
    index = group_pairs(pairs)
    instants = sorted(set().union(*present))
    assert len(index.stamps_ns) == len(instants)
    assert (np.diff(index.stamps_ns) > 0).all()
    for at, instant in enumerate(instants):
        having = [number for number in range(3) if instant in present[number]]
        assert [number for number in range(3) if index.rows[at, number, 0] >= 0] == having
        assert index.stamps_ns[at] == truth[instant] + delay_ns[having[0]]


def test_parse_stamp_is_exact() -> None:
    assert parse_stamp("1403636580838555649") == 1403636580838555649
    assert parse_stamp("1403636580838555649.0") == 1403636580838555649
    assert decimal_ns("1403636580.838555649", 10**9) == 1403636580838555649
    for text in ("", "x", "nan", "-1", "inf", "1e400", "9" * 30):
        assert parse_stamp(text) is None


@given(
    stamps=st.lists(  # 30 us apart at least: closer ones are refused as stamps in other units
        st.tuples(st.integers(0, 2**44), st.integers(0, 70_000)),
        min_size=1,
        max_size=20,
        unique_by=lambda each: each[0],
    ).map(lambda parts: sorted(100_000 * whole + beyond for whole, beyond in parts)),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    header=st.sampled_from(["", "#t,x", "t,x", "# a, remark"]),
)
def test_imu_csv_is_read_exactly(
    tmp_path_factory: pytest.TempPathFactory, stamps: list[int], end: str, header: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "imu.csv"
    rows = [header] * bool(header) + [f"{stamp},{i}.25,1e-3,0,-0.5,0,9.81" for i, stamp in enumerate(stamps)]
    path.write_bytes(end.join(rows).encode())
    faults = FaultLog("any")
    table = read_imu_csv(path, faults)
    assert len(table.stamps_ns) + sum(faults.counts.values()) == len(stamps)
    assert set(table.stamps_ns.tolist()) <= set(stamps)
    if not faults.counts:
        assert table.stamps_ns.tolist() == stamps
        assert table.values[:, 0].tolist() == [i + 0.25 for i in range(len(stamps))]


@given(st.binary(max_size=200), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8"]))
def test_decode_grey_of_any_bytes_raises_image_error(data: bytes, signature: bytes) -> None:
    with pytest.raises(ImageError, match=r"image\.png"):
        decode_grey(signature + data, "image.png")


def test_recording_memory_does_not_grow_with_length(tmp_path: Path) -> None:
    size_px = (320, 240)
    file = tmp_path / "image.png"
    write_image(file, noise_image(0, size_px))
    rig = small_rig(1)

    frames = 200
    stamps = np.arange(frames, dtype=np.int64) * 50 * MS
    track = ImageFiles(tmp_path, stamps, ["image.png"] * frames)
    imu = ImuTable(np.arange(0, frames * 50 * MS, 5 * MS), np.zeros((10 * frames, 6)))
    index = Index("long", {"cam0": track, "cam1": track}, imu)
    source = Source(index, _resized(rig, size_px), FaultLog("long"))
    tracemalloc.start()
    count = sum(isinstance(measurement, FrameSet) for measurement in source)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == frames
    # 8 framesets ahead, the files of those being decoded, and the one in use: a tenth of the recording
    assert peak < 20 * 2 * size_px[0] * size_px[1]


def _resized(rig: Rig, size_px: tuple[int, int]) -> Rig:
    pair = rig.pairs[0]
    left, right = (replace(camera, size_px=size_px) for camera in (pair.left, pair.right))
    return replace(rig, pairs=(replace(pair, left=left, right=right),))

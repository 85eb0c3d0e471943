"""Images of live cameras to framesets: as recordings have them, however they come; bounded in time and memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
import synthetic  # noqa: F401  (hypothesis' settings)
from hypothesis import given
from hypothesis import strategies as st
from recordings import small_rig

from graphvio.arrays import Image
from graphvio.live.clocks import ClockMaps
from graphvio.live.pairing import FramesetAssembler
from graphvio.measurements.sensors import FrameSet
from graphvio.sources.matching import group_pairs, match_sides

MS = 1_000_000
TOLERANCE_MS, WAIT_MS = 2.0, 100.0
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True, order=True)
class Shot:
    """An image that a camera ``cam0``, ``cam1`` ... takes and that comes later; milliseconds from the start."""

    arrival_ms: float
    camera: int
    stamp_ms: float


@dataclass
class Run:
    """What became of images; each shows its own number."""

    framesets: list[FrameSet] = field(default_factory=list)
    given_ms: list[float] = field(default_factory=list)
    reports: Counter[str] = field(default_factory=Counter)
    max_held: int = 0

    @property
    def numbers(self) -> list[int]:
        return [number_of(image) for each in self.framesets for pair in each.images.values() for image in pair]

    @property
    def stamps_ms(self) -> list[float]:
        return [(each.stamp_ns - START_NS) / MS for each in self.framesets]

    @property
    def pairs(self) -> list[list[int]]:
        return [sorted(each.images) for each in self.framesets]


def numbered(number: int) -> Image:
    return np.full((1, 4), np.frombuffer(np.uint32(number).tobytes(), dtype=np.uint8))


def number_of(image: Image) -> int:
    return int(np.frombuffer(image.tobytes(), dtype=np.uint32)[0])


def ns(ms: float) -> int:
    return START_NS + round(ms * MS)


def images_held(assembler: FramesetAssembler) -> int:
    unpaired = sum(len(camera.waiting) for camera in assembler._cameras())
    return unpaired + sum(len(group.cameras) * len(group.matched) for group in assembler._groups)


def play(shots: Sequence[Shot], pairs: int = 2, wait_ms: float = WAIT_MS, *, flush: bool = True) -> Run:
    """Hand over images in the order given; the numbers in them are their places in it."""
    run = Run()

    def report(stamp_ns: int, kind: str, detail: str) -> None:
        assert isinstance(stamp_ns, int)
        assert detail
        run.reports[kind] += 1

    def take(framesets: Iterable[FrameSet], now_ms: float) -> None:
        for each in framesets:
            run.framesets.append(each)
            run.given_ms.append(now_ms)

    assembler = FramesetAssembler(small_rig(pairs), TOLERANCE_MS, wait_ms, report)
    for number, shot in enumerate(shots):
        take(
            assembler.add(f"cam{shot.camera}", ns(shot.stamp_ms), numbered(number), ns(shot.arrival_ms)),
            shot.arrival_ms,
        )
        run.max_held = max(run.max_held, images_held(assembler))
    if flush:
        take(assembler.flush(), np.inf)
        assert images_held(assembler) == 0
        assert len(run.numbers) + run.reports.total() == len(shots)  # each image is in a frameset, or was reported
    assert len(set(run.numbers)) == len(run.numbers)  # none is in two
    assert all(np.diff([each.stamp_ns for each in run.framesets]) > 0)
    for each in run.framesets:
        for pair, (left, right) in each.images.items():
            sides = shots[number_of(left)], shots[number_of(right)]
            assert [shot.camera for shot in sides] == [2 * pair, 2 * pair + 1]
            assert abs(sides[0].stamp_ms - sides[1].stamp_ms) <= TOLERANCE_MS
            assert abs(ns(sides[0].stamp_ms) - each.stamp_ns) <= TOLERANCE_MS * MS
    return run


def as_recorded(shots: Sequence[Shot], pairs: int = 2) -> list[tuple[int, list[int]]]:
    """Stamps and pairs of the framesets that a recording of the same images has."""
    stamps = [
        np.sort(np.array([ns(s.stamp_ms) for s in shots if s.camera == c], dtype=np.int64)) for c in range(2 * pairs)
    ]
    tolerance_ns = round(TOLERANCE_MS * MS)
    matched = [match_sides(stamps[2 * p], stamps[2 * p + 1], tolerance_ns) for p in range(pairs)]
    index = group_pairs(matched, tolerance_ns)
    return [
        (int(stamp), [pair for pair in range(pairs) if rows[pair, 0] >= 0])
        for stamp, rows in zip(index.stamps_ns, index.rows, strict=True)
    ]


def steady(
    pairs: int = 2, count: int = 30, period_ms: float = 50.0, delay_ms: float = 5.0, offset_ms: float = 0.0
) -> list[Shot]:
    """All cameras at one rate; pair 1 is triggered later by an offset."""
    stamps = [(c, k * period_ms + (offset_ms if c // 2 == 1 else 0.0)) for k in range(count) for c in range(2 * pairs)]
    return sorted(Shot(stamp + delay_ms + 0.1 * camera, camera, stamp) for camera, stamp in stamps)


# ------------------------------------------------------------------ nothing goes wrong


def test_assembler_frameset_is_returned_with_last_image() -> None:
    run = play(steady(count=10))
    assert run.pairs == [[0, 1]] * 10
    assert run.stamps_ms == [50.0 * k for k in range(10)]
    assert run.given_ms == pytest.approx([50.0 * k + 5.3 for k in range(10)])
    assert not run.reports


@st.composite
def shuffled(draw: st.DrawFn) -> list[Shot]:
    """Two or three pairs at their own rates and instants; cameras deliver in order, each image up to 80 ms late.

    Stamps within a pair differ by up to the tolerance, and so may pairs.
    """
    shots = []
    for pair in range(draw(st.integers(1, 3))):
        stamp_ms = draw(st.sampled_from([0.0, 0.5, 1.5, 3.0, 10.0, 25.0]))
        period_ms = draw(st.sampled_from([20.0, 50.0]))
        skew_ms = draw(st.sampled_from([-2.0, 0.0, 0.7]))
        came = [0.0, 0.0]
        for _ in range(draw(st.integers(1, 12))):
            for side in range(2):
                came[side] = max(stamp_ms + 2.0 + draw(st.floats(0.0, 80.0)), came[side])
                shots.append(Shot(came[side], 2 * pair + side, stamp_ms + side * skew_ms))
            stamp_ms += period_ms
    return sorted(shots)


@given(shots=shuffled())
def test_assembler_any_order_equals_recording(shots: list[Shot]) -> None:
    pairs = 1 + max(shot.camera for shot in shots) // 2
    run = play(shots, pairs)
    assert not run.reports
    assert [(f.stamp_ns, sorted(f.images)) for f in run.framesets] == as_recorded(shots, pairs)


@given(orders=st.lists(st.permutations(range(8)), min_size=5, max_size=5))
def test_assembler_any_order_within_instant_gives_one_frameset(orders: list[list[int]]) -> None:
    """Of four pairs; another order at each instant."""
    shots = [
        Shot(50.0 * k + 6.0 * i, camera, 50.0 * k) for k, order in enumerate(orders) for i, camera in enumerate(order)
    ]
    run = play(shots, pairs=4)
    assert not run.reports
    assert run.pairs == [[0, 1, 2, 3]] * 5
    assert run.given_ms == [50.0 * k + 42.0 for k in range(5)]


@given(
    shots=st.lists(
        st.builds(Shot, st.floats(0.0, 2000.0), st.integers(0, 3), st.integers(0, 400).map(lambda k: 5.0 * k)),
        max_size=150,
    )
)
def test_assembler_invariants_hold_for_any_images(shots: list[Shot]) -> None:
    """Whatever comes in whatever order: `play` asserts them."""
    run = play(sorted(shots))
    again = play(sorted(shots))
    assert (run.numbers, run.reports) == (again.numbers, again.reports)


def test_assembler_chained_pairs_match_recording() -> None:
    """At 1.5, 0 and 3 ms: the third is none of the first two's, and their frameset steps back to make room."""
    shots = [
        Shot(50.0 * k + 10.0 + 0.1 * camera, camera, 50.0 * k + (1.5, 0.0, 3.0)[camera // 2])
        for k in range(5)
        for camera in range(6)
    ]
    run = play(shots, pairs=3)
    assert run.stamps_ms == [50.0 * k + at for k in range(5) for at in (0.0, 3.0)]
    assert [(f.stamp_ns, sorted(f.images)) for f in run.framesets] == as_recorded(shots, pairs=3)
    assert not run.reports


def test_assembler_two_devices_with_own_clocks_give_joint_framesets() -> None:
    """Pairs that are triggered together, on clocks 200 ppm apart; each has an IMU, too, and sends with jitter."""
    rng = np.random.default_rng(4)
    maps = ClockMaps(lambda *_: None)
    messages = []  # arrival, device, stamp by it, camera or none
    for device, drift in enumerate((-1e-4, 1e-4)):
        for k in range(4000):
            true_ms = 5.0 * k
            stamp_ns = round(true_ms * MS * (1.0 + drift)) + device * 10**12
            messages.append((true_ms + 1.0 + rng.exponential(1.0), device, stamp_ns, -1))
            if k % 10 == 0:
                for camera in (2 * device, 2 * device + 1):
                    messages.append((true_ms + 25.0 + rng.exponential(3.0), device, stamp_ns, camera))
    kinds: Counter[str] = Counter()
    assembler = FramesetAssembler(
        small_rig(2), TOLERANCE_MS, WAIT_MS, lambda stamp_ns, kind, detail: kinds.update([kind])
    )
    framesets = []
    for arrival_ms, device, stamp_ns, camera in sorted(messages):
        mapped = maps.map(f"device {device}", stamp_ns, ns(arrival_ms))
        assert mapped is not None
        if camera < 0:
            framesets += assembler.advance(ns(arrival_ms))
        else:
            framesets += assembler.add(f"cam{camera}", mapped, numbered(0), ns(arrival_ms))
    framesets += assembler.flush()
    assert not kinds
    later = [each for each in framesets if each.stamp_ns > ns(980.0)]
    assert [sorted(each.images) for each in later] == [[0, 1]] * 380
    errors_ms = [(each.stamp_ns - ns(1001.0 + 50.0 * k)) / MS for k, each in enumerate(later)]
    assert np.abs(errors_ms).max() < 1.0
    assert np.abs(errors_ms[180:]).max() < 0.1


# ------------------------------------------------------------------ what a frameset waits for


def test_assembler_unsynchronised_pairs_give_separate_framesets() -> None:
    run = play(steady(offset_ms=20.0))
    assert run.pairs == [[0], [1]] * 30
    assert not run.reports
    waits = np.subtract(run.given_ms, run.stamps_ms)[:-1]
    assert waits.max() <= 30.0 + 5.3 + 1e-6  # until the other pair's next image, 30 ms later


def test_assembler_camera_at_half_rate_halves_its_pair() -> None:
    shots = [shot for shot in steady(count=30) if shot.camera != 3 or shot.stamp_ms % 100.0 == 0.0]
    run = play(shots)
    assert run.pairs == [[0, 1], [0]] * 15
    assert run.reports == {"image_without_partner": 15}
    assert np.subtract(run.given_ms, run.stamps_ms)[:-1].max() <= WAIT_MS


def test_assembler_pair_at_half_rate_delays_other_to_next_image() -> None:
    shots = [shot for shot in steady(count=30) if shot.camera < 2 or shot.stamp_ms % 100.0 == 0.0]
    run = play(shots)
    assert run.pairs == [[0, 1], [0]] * 15
    assert not run.reports
    assert np.subtract(run.given_ms, run.stamps_ms)[:-1].max() <= 50.0 + 5.3 + 1e-6


def test_assembler_lost_image_costs_pair_one_frameset() -> None:
    shots = [shot for shot in steady(count=10) if (shot.camera, shot.stamp_ms) != (2, 200.0)]
    run = play(shots)
    assert run.pairs == [[0] if k == 4 else [0, 1] for k in range(10)]
    assert run.reports == {"image_without_partner": 1}
    assert run.given_ms[4] < 256.0  # the camera's next image shows that it is lost


def test_assembler_pair_that_stops_and_returns_is_used_again() -> None:
    shots = [shot for shot in steady(count=100) if shot.camera < 2 or not 1000.0 <= shot.stamp_ms < 3500.0]
    run = play(shots)
    assert run.pairs == [[0] if 20 <= k < 71 else [0, 1] for k in range(100)]
    assert run.reports == {"late_image": 1, "image_without_partner": 1}  # the first after the return was not waited for
    waits = np.subtract(run.given_ms, run.stamps_ms)
    assert waits[:20].max() < 6.0
    assert waits[20:40].max() <= WAIT_MS + 50.0 + 6.0  # the time is given by what arrives
    assert waits[45:69].max() < 6.0  # nothing waits any more
    assert waits[72:].max() < 6.0


def test_assembler_silent_rig_continues() -> None:
    """For ten seconds, so that the first stamps afterwards have to be confirmed by the next ones."""
    shots = [shot for shot in steady(count=300) if not 2000.0 <= shot.stamp_ms < 12000.0]
    run = play(shots)
    assert run.pairs == [[0, 1]] * 100
    assert not run.reports


def test_assembler_missing_pair_is_not_waited_for() -> None:
    run = play([shot for shot in steady(count=60) if shot.camera < 2])
    assert run.pairs == [[0]] * 60
    waits = np.subtract(run.given_ms, run.stamps_ms)
    assert waits[25:].max() < 6.0


def test_assembler_advance_ends_wait() -> None:
    """Both pairs are alive, but only one has the instant; IMU samples give the time."""
    assembler = FramesetAssembler(small_rig(2), TOLERANCE_MS, WAIT_MS, lambda *_: None)
    for camera in range(2):
        assert not assembler.add(f"cam{camera}", ns(0.0), numbered(camera), ns(5.0 + camera))
    assert not assembler.advance(ns(104.0))
    (frameset,) = assembler.advance(ns(105.0))
    assert sorted(frameset.images) == [0]


@pytest.mark.parametrize("seed", range(3))
def test_assembler_stamp_jitter_of_half_a_period_is_handled(seed: int) -> None:
    """Each camera for itself: hardly any image has a partner, and those that have one are used."""
    rng = np.random.default_rng(seed)
    shots = [Shot(50.0 * k + 30.0, c, 50.0 * k + rng.uniform(-25.0, 25.0)) for k in range(200) for c in range(4)]
    run = play(shots)
    recorded = sum(len(pairs) for _, pairs in as_recorded(shots))
    assert recorded > 10
    assert sum(map(len, run.pairs)) == pytest.approx(recorded, abs=3)  # images that cross are in another order
    assert set(run.reports) <= {"image_without_partner", "late_image"}


# ------------------------------------------------------------------ faults


def test_assembler_duplicate_image_is_used_once() -> None:
    shots = steady(count=5)
    run = play(sorted([*shots, Shot(107.0, 1, 100.0), Shot(105.05, 0, 100.0)]))
    assert run.pairs == [[0, 1]] * 5
    assert run.reports == {"duplicate_image": 2}


def test_assembler_image_after_its_frameset_is_late() -> None:
    shots = steady(count=10)
    late = [Shot(shot.arrival_ms + 140.0, shot.camera, shot.stamp_ms) for shot in shots if shot.camera >= 2][6:8]
    kept = [shot for shot in shots if (shot.camera, shot.stamp_ms) not in [(s.camera, s.stamp_ms) for s in late]]
    run = play(sorted(kept + late))
    assert run.pairs == [[0] if k == 3 else [0, 1] for k in range(10)]
    assert run.reports == {"late_image": 2}


def test_assembler_wild_stamp_blocks_nothing() -> None:
    shots = [
        Shot(shot.arrival_ms, shot.camera, shot.stamp_ms + (1e6 if 200.0 <= shot.stamp_ms < 250.0 else 0.0))
        for shot in steady(count=10)
    ]
    run = play(shots)
    assert run.stamps_ms == [50.0 * k for k in range(10) if k != 4]
    assert run.reports == {"image_future_stamp": 4}


def test_assembler_slightly_wild_stamp_costs_two_framesets() -> None:
    """Its camera does not count as past all that follows, but for its next image."""
    shots = [
        Shot(
            shot.arrival_ms,
            shot.camera,
            shot.stamp_ms + (3000.0 if (shot.camera, shot.stamp_ms) == (2, 200.0) else 0.0),
        )
        for shot in steady(count=20)
    ]
    run = play(shots)
    assert run.pairs == [[0] if k in (4, 5) else [0, 1] for k in range(20)]
    assert run.reports == {"image_without_partner": 3, "late_image": 1}


def test_assembler_image_without_partner_does_not_change_stamp() -> None:
    """Pair 1 is half a millisecond before pair 0, whose stamp counts."""
    shots = steady(count=10, offset_ms=-0.5)
    run = play(sorted([*shots, Shot(200.0, 2, 180.0)]))
    assert run.stamps_ms == [50.0 * k for k in range(10)]
    assert run.reports == {"image_without_partner": 1}


def test_assembler_unknown_camera_is_reported() -> None:
    assert play([Shot(1.0, 9, 0.0)]).reports == {"unknown_camera": 1}


@pytest.mark.parametrize("cameras", [(0,), (0, 1), (0, 3), (0, 1, 2)])
def test_assembler_memory_is_bounded_when_no_time_passes(cameras: tuple[int, ...]) -> None:
    """A clock of arrivals that stands still ends no wait."""
    shots = [Shot(0.0, camera, 50.0 * k) for k in range(500) for camera in cameras]
    run = play(shots)
    assert run.max_held <= 4 * 33
    assert len(run.framesets) == (500 if 1 in cameras else 0)


def test_assembler_memory_is_bounded_over_time() -> None:
    run = play(steady(count=2000, delay_ms=60.0), flush=False)
    assert len(run.framesets) == 2000
    assert run.max_held <= 12

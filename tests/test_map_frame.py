"""The map frame, by corrections of synthetic chains of keyframes with random drift."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, kstest
from synthetic import random_covariance, random_transform, transform

from graphvio import MeasurementError
from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.measurements.estimate import Status
from graphvio.slam import map_frame
from graphvio.slam.keyframe import Keyframe, Landmarks
from graphvio.slam.map_frame import MapFrame

SURE = 1.0 - 1e-12  # no random correction is refused
DRIFT_SIGMAS = np.repeat([2e-3, 6e-3], 3)
SIGMAS = np.repeat([5e-3, 2e-2], 3)  # of corrections


@dataclass
class Chain:
    """Keyframes, and their true poses in the map."""

    keyframes: list[Keyframe]
    map_T_body: list[Float]

    def corrected(self, k: int, rng: np.random.Generator) -> tuple[int, Float, Float]:
        """Return a noisy correction of the k-th keyframe."""
        return self.keyframes[k].id, self.map_T_body[k] @ se3_exp(SIGMAS * rng.standard_normal(6)), np.diag(SIGMAS**2)


def chain(rng: np.random.Generator, count: int, epoch: int = 0, first_id: int = 0) -> Chain:
    """A walk of 1 m steps whose odometry drifts by as much as its relative covariances say."""
    made = Chain([], [])
    map_T_body, odom_T_body = random_transform(rng, 1.0, 20.0), random_transform(rng, 0.5, 2.0)
    spread = np.diag(DRIFT_SIGMAS**2)
    for k in range(count):
        step: Float | None = None
        if k:
            true = transform(0.2 * rng.standard_normal(3), np.array([1.0, 0.0, 0.0]) + 0.1 * rng.standard_normal(3))
            step = true @ se3_exp(DRIFT_SIGMAS * rng.standard_normal(6))
            map_T_body, odom_T_body = map_T_body @ true, odom_T_body @ step
        made.map_T_body.append(map_T_body)
        made.keyframes.append(
            Keyframe(
                id=first_id + k,
                epoch=epoch,
                stamp_ns=k * 10**9,
                status=Status.TRACKING,
                odom_T_body=odom_T_body,
                covariance=(k + 1.0) * spread,
                previous_id=first_id + k - 1 if k else None,
                previous_T_body=step,
                relative_covariance=spread if k else None,
                landmarks=Landmarks.none(),
            )
        )
    return made


def frame_with(keyframes: Sequence[Keyframe], probability: float = SURE) -> MapFrame:
    made = MapFrame(probability)
    for keyframe in keyframes:
        made.add(keyframe)
    return made


def in_force(frame: MapFrame) -> Float:
    found = frame.map_T_odom
    assert found is not None
    return found


def covariance_at_the_end(keyframes: Sequence[Keyframe], corrected: Sequence[int]) -> Float:
    """Return the covariance (6, 6) of ``map_T_odom`` at the last keyframe, by the normal equations of all keyframes."""
    count = len(keyframes)
    information = np.zeros((6 * count, 6 * count))
    for k in range(count):
        from_odom = se3_adjoint(se3_inverse(keyframes[k].odom_T_body))  # an error in odom as one in body
        now = slice(6 * k, 6 * k + 6)
        if k in corrected:
            information[now, now] += from_odom.T @ np.diag(SIGMAS**-2.0) @ from_odom
        if k:
            between = np.zeros((6, 6 * count))
            between[:, now], between[:, 6 * k - 6 : 6 * k] = from_odom, -from_odom
            information += between.T @ np.diag(DRIFT_SIGMAS**-2.0) @ between
    return np.asarray(np.linalg.solve(information, np.eye(6 * count)[:, -6:])[-6:])


# ------------------------------------------------------------------ what is believed


def test_errors_in_the_map_are_consistent() -> None:
    runs, count = 120, 20
    squares = []
    for number in range(runs):
        rng = np.random.default_rng([1, number])
        walk = chain(rng, count)
        frame = frame_with(walk.keyframes)
        corrected = rng.choice(count - 3, size=6, replace=False)  # in no order, and none at the end
        for k in corrected:
            assert frame.correct(*walk.corrected(k, rng)).accepted
        odom_T_body = walk.keyframes[-1].odom_T_body
        error = se3_log(se3_inverse(walk.map_T_body[-1]) @ in_force(frame) @ odom_T_body)
        from_odom = se3_adjoint(se3_inverse(odom_T_body))
        covariance = from_odom @ covariance_at_the_end(walk.keyframes, corrected.tolist()) @ from_odom.T
        squares.append(error @ np.linalg.solve(covariance, error))
    # A filter that weighs wrongly has larger errors than the normal equations allow.
    assert np.mean(squares) == pytest.approx(6.0, abs=3.0 * np.sqrt(12.0 / runs))


@given(st.permutations(range(8)), st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_order_of_corrections_makes_no_difference(order: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    walk = chain(rng, 20)
    corrections = [walk.corrected(2 * k, rng) for k in range(8)]
    in_order, in_any = frame_with(walk.keyframes), frame_with(walk.keyframes)
    for each in corrections:
        assert in_order.correct(*each).accepted
    for k in order:
        assert in_any.correct(*corrections[k]).accepted
    np.testing.assert_array_equal(in_any.map_T_odom, in_order.map_T_odom)


def test_late_correction_counts_as_an_early_one() -> None:
    rng = np.random.default_rng(5)
    walk = chain(rng, 30)
    corrections = [walk.corrected(k, rng) for k in (3, 10)]
    late, at_once = frame_with(walk.keyframes), frame_with(walk.keyframes[:11])
    for each in corrections:
        late.correct(*each)
        at_once.correct(*each)
    for keyframe in walk.keyframes[11:]:
        at_once.add(keyframe)
    last = walk.corrected(29, rng)
    assert late.correct(*last).statistic == at_once.correct(*last).statistic
    np.testing.assert_array_equal(in_force(late), in_force(at_once))


def test_first_correction_is_accepted_unchanged() -> None:
    rng = np.random.default_rng(6)
    walk = chain(rng, 5)
    frame = frame_with(walk.keyframes, 0.9)
    assert frame.map_T_odom is None
    anywhere = random_transform(rng, 3.0, 1e3)
    result = frame.correct(2, anywhere, random_covariance(rng, 6, 1e-4))
    assert (result.accepted, result.reason, result.statistic) == (True, "", None)
    np.testing.assert_allclose(in_force(frame) @ walk.keyframes[2].odom_T_body, anywhere, atol=1e-9)
    assert result.map_T_odom is not None
    result.map_T_odom[:] = 0.0  # it is the caller's own
    np.testing.assert_allclose(in_force(frame) @ walk.keyframes[2].odom_T_body, anywhere, atol=1e-9)


def test_second_correction_of_a_keyframe_replaces_the_first() -> None:
    rng = np.random.default_rng(7)
    walk = chain(rng, 10)
    first, old, new = walk.corrected(0, rng), walk.corrected(6, rng), walk.corrected(6, rng)
    twice, once = frame_with(walk.keyframes), frame_with(walk.keyframes)
    for each in (first, old, *[new] * 20):
        assert twice.correct(*each).accepted
    for each in (first, new):
        assert once.correct(*each).accepted
    np.testing.assert_array_equal(in_force(twice), in_force(once))
    # Nor is it believed the more for being said twenty times.
    last = walk.corrected(9, rng)
    assert twice.correct(*last).statistic == once.correct(*last).statistic


def test_the_smoothers_correction_of_the_previous_keyframe_is_drift() -> None:
    rng = np.random.default_rng(8)
    walk = chain(rng, 2)
    before, now = walk.keyframes
    known = se3_inverse(before.odom_T_body) @ now.odom_T_body
    shift = np.array([0.0, 0.0, 0.01, 0.2, 0.0, 0.0])
    moved = frame_with([before, replace(now, previous_T_body=known @ se3_exp(-shift))])
    still = frame_with([before, replace(now, previous_T_body=known)])
    tight = np.diag(np.repeat([1e-6, 1e-6], 3))
    correction = walk.map_T_body[0] @ known @ se3_exp(shift)
    for frame in (moved, still):
        frame.correct(0, walk.map_T_body[0], tight)
    statistics = [frame.correct(1, correction, tight).statistic for frame in (moved, still)]
    assert statistics[0] is not None
    assert statistics[1] is not None
    assert statistics[0] < 1.0  # as much as was expected
    assert statistics[1] > 100.0


# ------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(("earlier", "tested"), [((2,), 9), ((2, 6), 9), ((2, 9), 5), ((5, 9), 2)])
def test_correct_corrections_are_refused_at_the_configured_rate(earlier: tuple[int, ...], tested: int) -> None:
    """In order, between others and before all of them: squared distances are chi-square's."""
    statistics = []
    for number in range(400):
        rng = np.random.default_rng([2, tested, number])
        walk = chain(rng, 10)
        frame = frame_with(walk.keyframes)
        for k in earlier:
            frame.correct(*walk.corrected(k, rng))
        result = frame.correct(*walk.corrected(tested, rng))
        assert result.statistic is not None
        statistics.append(result.statistic)
    assert kstest(statistics, chi2(6).cdf).pvalue > 0.01
    refused = np.mean(np.array(statistics) > chi2.ppf(0.95, 6))
    assert refused == pytest.approx(0.05, abs=3.0 * np.sqrt(0.05 * 0.95 / 400))


def test_threshold_is_the_quantile_of_the_probability() -> None:
    accepted = 0
    for number in range(400):
        rng = np.random.default_rng([3, number])
        walk = chain(rng, 6)
        frame = frame_with(walk.keyframes, 0.9)
        frame.correct(*walk.corrected(0, rng))
        result = frame.correct(*walk.corrected(5, rng))
        assert result.threshold == pytest.approx(chi2.ppf(0.9, 6))
        accepted += result.accepted
    assert accepted / 400 == pytest.approx(0.9, abs=3.0 * np.sqrt(0.09 / 400))


def test_wrong_correction_is_refused_and_moves_nothing() -> None:
    rng = np.random.default_rng(9)
    walk = chain(rng, 12)
    frame = frame_with(walk.keyframes, 0.999)
    for k in (1, 4, 8):
        assert frame.correct(*walk.corrected(k, rng)).accepted
    before = in_force(frame)
    for k in (11, 6):  # in time, and late
        keyframe_id, pose, covariance = walk.corrected(k, rng)
        result = frame.correct(keyframe_id, pose @ transform([0, 0, 0], [0, 2.0, 0]), covariance)
        assert not result.accepted
        assert f"keyframe {k}: squared distance {result.statistic:.1f} beyond chi-square 22.5" in result.reason
        np.testing.assert_array_equal(result.map_T_odom, before)
    np.testing.assert_array_equal(in_force(frame), before)


@pytest.mark.parametrize(
    ("pattern", "moves"), [("AB" * 40, 0), ("AAABBB" * 20, 1), ("AABB" * 20, 0), ("A" + "B" * 60, 1), ("A" * 80, 0)]
)
def test_contradicting_corrections_do_not_alternate(pattern: str, moves: int) -> None:
    rng = np.random.default_rng(10)
    walk = chain(rng, len(pattern))
    frame = frame_with(walk.keyframes, 0.999)
    off = {"A": np.eye(4), "B": transform([0, 0, 0.5], [5.0, 0, 0])}
    moved = 0
    for k, side in enumerate(pattern):
        keyframe_id, pose, covariance = walk.corrected(k, rng)
        moved += "refused corrections in a row agree" in frame.correct(keyframe_id, off[side] @ pose, covariance).reason
    assert moved == moves
    true = walk.map_T_body[-1] @ se3_inverse(walk.keyframes[-1].odom_T_body)
    side = "B" if moves else "A"
    assert np.linalg.norm(se3_log(se3_inverse(off[side] @ true) @ in_force(frame))) < 0.5


def test_two_contradicting_sources_move_the_map_ever_more_rarely() -> None:
    rng = np.random.default_rng(11)
    lengths = [3 * 2**k for k in range(7)]
    walk = chain(rng, sum(lengths))
    frame = frame_with(walk.keyframes, 0.999)
    off, moves = (np.eye(4), transform([0, 0, 0.5], [5.0, 0, 0])), 0
    sides = [turn % 2 for turn, length in enumerate(lengths) for _ in range(length)]
    for k, side in enumerate(sides):
        keyframe_id, pose, covariance = walk.corrected(k, rng)
        moves += bool("agree" in frame.correct(keyframe_id, off[side] @ pose, covariance).reason)
    assert 2 <= moves <= np.log2(len(sides) / 3) + 1


def test_repeated_corrections_of_a_keyframe_count_once() -> None:
    rng = np.random.default_rng(12)
    walk = chain(rng, 10)
    frame = frame_with(walk.keyframes, 0.999)
    frame.correct(*walk.corrected(0, rng))
    off = transform([0, 0, 0], [5.0, 0, 0])
    keyframe_id, pose, covariance = walk.corrected(5, rng)
    assert not any(frame.correct(keyframe_id, off @ pose, covariance).accepted for _ in range(10))
    for k in (6, 7):
        keyframe_id, pose, covariance = walk.corrected(k, rng)
        assert frame.correct(keyframe_id, off @ pose, covariance).accepted == (k == 7)


def test_new_epoch_resets_the_map() -> None:
    rng = np.random.default_rng(13)
    old, new = chain(rng, 4), chain(rng, 4, epoch=1, first_id=4)
    frame = frame_with(old.keyframes)
    frame.correct(*old.corrected(2, rng))
    np.testing.assert_array_equal(frame.of_epoch(0), in_force(frame))
    assert frame.of_epoch(1) is None
    frame.begin(1)  # before its first keyframe
    assert frame.map_T_odom is None
    for keyframe in new.keyframes:
        frame.add(keyframe)
    result = frame.correct(*old.corrected(2, rng))
    assert not result.accepted
    assert "keyframe 2 is not of the newest epoch" in result.reason
    assert frame.map_T_odom is None
    assert frame.correct(*new.corrected(1, rng)).accepted
    assert frame.of_epoch(0) is None
    assert not frame.correct(99, np.eye(4), np.eye(6)).accepted


def test_no_epoch_gets_the_map_of_another() -> None:
    rng = np.random.default_rng(14)
    first, frame = chain(rng, 1).keyframes[0], MapFrame(SURE)
    epochs, wrong, is_over = 1000, [], threading.Event()
    newest = [0]

    def read() -> None:
        while not is_over.is_set():
            for epoch in (newest[0], newest[0] + 1):
                found = frame.of_epoch(epoch)
                if found is not None and round(found[0, 3]) != epoch:
                    wrong.append(epoch)

    reader = threading.Thread(target=read)
    reader.start()
    for epoch in range(epochs):
        newest[0] = epoch
        frame.add(replace(first, epoch=epoch, id=epoch, odom_T_body=np.eye(4)))
        frame.correct(epoch, transform([0, 0, 0], [float(epoch), 0, 0]), np.eye(6))
    is_over.set()
    reader.join()
    assert not wrong


# ------------------------------------------------------------------ what is kept


def test_merged_corrections_lose_no_information(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(15)
    walk = chain(rng, 60)
    corrections = [walk.corrected(k, rng) for k in range(60) if k != 5]
    whole = frame_with(walk.keyframes)
    for each in corrections:
        whole.correct(*each)
    monkeypatch.setattr(map_frame, "_MAX_CORRECTIONS", 20)
    merged = frame_with(walk.keyframes)
    for each in corrections:
        merged.correct(*each)
    assert len(merged._accepted) <= 20
    np.testing.assert_array_equal(in_force(merged), in_force(whole))
    # One that is older than what was merged, or of its last keyframe, is taken in nearly as it should be.
    sigmas = np.sqrt(np.diag(covariance_at_the_end(walk.keyframes, range(60))))
    for late in (walk.corrected(5, rng), walk.corrected(merged._accepted[0].keyframe_id, rng)):
        for frame in (merged, whole):
            assert frame.correct(*late).accepted
        apart = se3_log(se3_inverse(in_force(whole)) @ in_force(merged))
        assert (np.abs(apart) < 0.1 * sigmas).all()
    assert sum(each.is_many for each in merged._accepted) == 1


def test_drift_since_a_dropped_keyframe_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(16)
    walk = chain(rng, 50)
    first, last = walk.corrected(0, rng), walk.corrected(49, rng)
    statistics = []
    for most in (1000, 10):
        monkeypatch.setattr(map_frame, "_MAX_KEYFRAMES", most)
        frame = frame_with(walk.keyframes[:1])
        frame.correct(*first)
        for keyframe in walk.keyframes[1:]:
            frame.add(keyframe)
        statistics.append(frame.correct(*last).statistic)
    assert statistics[0] == statistics[1]
    assert "too old" in frame.correct(*first).reason


@pytest.mark.parametrize(
    ("pose", "covariance", "message"),
    [
        (np.eye(3), np.eye(6), r"map_T_body: has shape \(3, 3\)"),
        (np.full((4, 4), np.nan), np.eye(6), "holds NaN"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), np.eye(6), "holds no rotation .*differs from 1 by 3"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(6), "holds no rotation"),
        ("here", np.eye(6), "not an array of numbers"),
        (np.eye(4), np.eye(3), r"covariance: has shape \(3, 3\)"),
        (np.eye(4), -np.eye(6), "positive definite"),
        (np.eye(4), np.zeros((6, 6)), "positive definite"),
        (np.eye(4), np.eye(6) + np.eye(6, k=1), "not symmetric"),
        (np.eye(4), [[1.0], [1.0, 2.0]], "not an array of numbers"),
    ],
)
def test_invalid_pose_or_covariance_raises(pose: Float, covariance: Float, message: str) -> None:
    frame = frame_with(chain(np.random.default_rng(17), 2).keyframes)
    with pytest.raises(MeasurementError, match=message):
        frame.correct(0, pose, covariance)
    assert frame.map_T_odom is None

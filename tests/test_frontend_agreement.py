"""Pairs that contradict each other, points that move on their own, and what is then said of a motion."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from synthetic import random_transform, seen_points, transform, two_pair_rig

from graphvio.arrays import AnyArray, Bool, Float
from graphvio.config import Config
from graphvio.config.stages import MotionConfig
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.imaging.frozen import Frozen
from graphvio.frontend.motion.observations import Correspondences, Observations, RigArrays
from graphvio.frontend.motion.quality import StereoShare, checked_hypothesis, motion_with_quality, stereo_share
from graphvio.frontend.motion.refinement import Refined
from graphvio.frontend.motion.selection import searched_and_refined
from graphvio.frontend.pairs.agreement import Agreement, MotionHypothesis, _consensus_sets, _in_order, agree
from graphvio.frontend.pairs.pair_reports import pair_reports
from graphvio.frontend.tracking_frontend import TrackedFrameset
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.measurements.motion import Quality, RelativeMotion

RIG = two_pair_rig()
ARRAYS = RigArrays.of(RIG)
CONFIG = MotionConfig()
STILL = np.eye(4)
TRUTH = transform([0.01, -0.03, 0.02], [0.05, -0.02, 0.03])
DOOR = transform([0.0, 0.05, 0.0], [0.08, 0.04, 0.0])
OTHER_DOOR = transform([0.03, 0.0, -0.04], [-0.05, 0.06, 0.0])


def agreement_of(
    seen: Observations,
    seed: int = 0,
    arrays: RigArrays = ARRAYS,
    in_doubt: bool = False,
    uncertain: Mapping[int, Float] | None = None,
) -> Agreement:
    rng = np.random.default_rng(seed)
    joint = searched_and_refined(arrays, seen, STILL, CONFIG, rng)
    return agree(arrays, seen, joint, CONFIG, rng, uncertain or {}, in_doubt)


def mixed(first: tuple[Float, int], second: tuple[Float, int], seed: int = 0) -> Observations:
    """The first pair's points under one motion, the second's under another."""
    parts = []
    for pair, (motion, count) in enumerate((first, second)):
        parts.append(seen_points(RIG, motion, count, np.random.default_rng(seed), sigma_px=0.2).of_pair(pair))
    return joined(*parts)


def joined(first: Observations, second: Observations) -> Observations:
    """All points of both, sorted by pair."""
    columns = [np.concatenate(parts) for parts in zip(first, second, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    return Observations._make(column[order] for column in columns)


def distance(motion: Float, truth: Float) -> float:
    return float(np.linalg.norm(se3_log(np.ascontiguousarray(motion @ np.linalg.inv(truth)))))


def test_pairs_that_see_one_world_agree() -> None:
    distances = []
    for seed in range(40):
        agreement = agreement_of(mixed((TRUTH, 80), (TRUTH, 80), seed), seed)
        assert len(agreement.hypotheses) == 1
        assert agreement.hypotheses[0].pairs == (0, 1)
        assert set(agreement.own) == {0, 1}
        distances.append(agreement.max_distance)
    assert np.mean(distances) < 8.0  # chi-square of 6, and the covariances are a little too large


@pytest.mark.parametrize(("points", "first"), [((120, 60), 0), ((60, 120), 1)])
def test_a_door_that_fills_one_view_is_a_side_of_its_own(points: tuple[int, int], first: int) -> None:
    agreement = agreement_of(mixed((TRUTH, points[0]), (DOOR, points[1])))
    assert [side.pairs for side in agreement.hypotheses] == [(first,), (1 - first,)]
    for side in agreement.hypotheses:
        assert distance(side.refined.cur_T_ref, (TRUTH, DOOR)[side.pairs[0]]) < 5e-3
        assert side.refined.inlier.sum() > 0.95 * points[side.pairs[0]]
        assert len(side.refined.inlier) == sum(points)


def test_of_sides_with_about_the_same_support_the_first_pair_comes_first() -> None:
    """Else an error of P_12 would have the sides change places again and again."""
    for points in ((100, 110), (110, 100)):
        assert [side.pairs for side in agreement_of(mixed((TRUTH, points[0]), (DOOR, points[1]))).hypotheses] == [
            (0,),
            (1,),
        ]


def test_pairs_that_contradicted_each_other_in_doubt_separate_sooner() -> None:
    off = transform([0.001, 0.0, 0.0], [0.0, 0.0, 0.0]) @ TRUTH  # between 2 and 5 sigma
    seen = mixed((TRUTH, 80), (off, 80))
    usual, doubtful = agreement_of(seen), agreement_of(seen, in_doubt=True)
    assert 12.6 < usual.max_distance < 40.0
    assert (len(usual.hypotheses), len(doubtful.hypotheses)) == (1, 2)
    assert not usual.contradicts
    assert not doubtful.contradicts  # or doubt would feed itself
    assert agreement_of(mixed((TRUTH, 80), (DOOR, 80)), in_doubt=True).contradicts
    assert len(agreement_of(mixed((TRUTH, 80), (TRUTH, 80)), in_doubt=True).hypotheses) == 1


def test_consensus_set_has_pairs_that_all_agree() -> None:
    apart = {(0, 1): 30.0, (0, 2): 100.0, (1, 2): 30.0}  # a chain: the middle one agrees with both ends
    assert _consensus_sets([1, 0, 2], apart, in_doubt=False) == [[1, 0], [2]]
    assert _consensus_sets([2, 1, 0], apart, in_doubt=False) == [[2, 1], [0]]
    assert _consensus_sets([0, 1, 2], apart, in_doubt=True) == [[0], [1], [2]]
    assert _consensus_sets([0, 1, 2], dict.fromkeys(apart, 10.0), in_doubt=True) == [[0, 1, 2]]
    assert _consensus_sets([], {}, in_doubt=False) == []


NOT_FROZEN = Frozen(frozenset(), None, "")


def test_doubt_lasts_a_second() -> None:
    off = transform([0.001, 0.0, 0.0], [0.0, 0.0, 0.0]) @ TRUTH
    slightly, plainly = mixed((TRUTH, 80), (off, 80)), mixed((TRUTH, 80), (DOOR, 80))
    frontend = VisualFrontend(RIG, Config())
    sides = {}
    for milliseconds, seen in ((0, slightly), (500, plainly), (1450, slightly), (1550, slightly)):
        frames = {0: TrackedFrame.empty()}
        correspondences = Correspondences(seen, {}, {})
        tracked = TrackedFrameset(milliseconds * 1_000_000, NOT_FROZEN, frames, frames, correspondences, None)
        agreement, _ = frontend._estimate_motion(tracked, lambda _: STILL)
        assert agreement is not None
        sides[milliseconds] = len(agreement.hypotheses)
    frontend.close()
    assert sides == {0: 1, 500: 2, 1450: 2, 1550: 1}


PLACE = 0.1**2 * np.eye(6)  # corrected, but hardly known


def test_what_is_not_known_of_a_pairs_place_is_in_its_motions_covariance() -> None:
    """Together with another pair, as a side of its own, and alone."""
    seen = mixed((TRUTH, 80), (TRUTH, 80))
    exact, corrected = agreement_of(seen), agreement_of(seen, uncertain={1: PLACE})
    assert len(corrected.hypotheses) == 1
    weighed = corrected.hypotheses[0].refined
    trusted = corrected.own[0].cur_T_ref
    assert distance(weighed.cur_T_ref, trusted) < distance(exact.hypotheses[0].refined.cur_T_ref, trusted)
    assert np.trace(weighed.covariance) > 1.2 * np.trace(exact.hypotheses[0].refined.covariance)
    np.testing.assert_array_equal(corrected.own[1].covariance, exact.own[1].covariance)  # watching P_12 needs it bare
    contradicted = agreement_of(mixed((TRUTH, 80), (DOOR, 80)), uncertain={1: PLACE}).hypotheses[1]
    assert contradicted.pairs == (1,)
    alone = agreement_of(seen.of_pair(1), uncertain={1: PLACE}).hypotheses[0]
    for side in (contradicted, alone):
        lever = 0.1 * np.linalg.norm(se3_adjoint(side.refined.cur_T_ref) - np.eye(6), axis=1)
        assert np.all(np.sqrt(np.diag(side.refined.covariance)) > lever)


def test_an_error_of_p12_that_is_known_to_be_possible_is_no_contradiction() -> None:
    off = np.array([0.05, 0.0, -0.05, 0.0, 0.0, 0.0])
    seen = mixed((TRUTH, 80), (se3_exp(-off) @ TRUTH @ se3_exp(off), 80))
    assert agreement_of(seen).contradicts
    assert not agreement_of(seen, uncertain={1: PLACE}).contradicts


def test_errors_that_the_pairs_have_in_common_are_no_contradiction() -> None:
    """An error that turns the motion of one pair and not that of the other, such as of a gyro within the readout."""
    turned = transform([0.0, 0.003, 0.0], [0.0, 0.0, 0.0]) @ TRUTH
    seen = mixed((TRUTH, 80), (turned, 80))
    by_error = {0: np.zeros((6, 1)), 1: np.eye(6)[:, 1:2] * 0.003}
    rng = np.random.default_rng(0)
    joint = searched_and_refined(ARRAYS, seen, STILL, CONFIG, rng)
    assert agreement_of(seen).contradicts
    for shared, contradicts in ((by_error, False), (dict.fromkeys((0, 1), by_error[1]), True)):

        def of_pair(pair: int, inlier: Bool, cur_T_ref: Float, shared: Mapping[int, Float] = shared) -> Float:
            return shared[pair]

        agreement = agree(ARRAYS, seen, joint, CONFIG, rng, shared_errors=of_pair)
        assert agreement.contradicts == contradicts
    assert agreement.own[0].covariance[1, 1] > 0.003**2  # the motions are as uncertain as the error


def test_a_second_motion_of_all_pairs_is_not_mixed_with_what_the_pairs_say_alone() -> None:
    """Each view has a door of its own that outnumbers the world: the world's motion is nobody's, and stays itself."""
    world = mixed((TRUTH, 30), (TRUTH, 30), 3)
    seen = joined(world, mixed((DOOR, 40), (OTHER_DOOR, 40), 4))
    sides = agreement_of(seen, uncertain={1: 1e-8 * np.eye(6)}).hypotheses
    assert sides[0].pairs == (0, 1)
    assert distance(sides[0].refined.cur_T_ref, TRUTH) < 5e-3


def test_the_order_of_sides() -> None:
    def order(*sides: tuple[tuple[int, ...], int]) -> list[tuple[int, ...]]:
        refined = agreement_of(mixed((TRUTH, 60), (TRUTH, 60))).hypotheses[0].refined
        return [
            side.pairs
            for side in _in_order([MotionHypothesis(p, replace(refined, inlier=np.arange(200) < n)) for p, n in sides])
        ]

    assert order(((1,), 100), ((0,), 90)) == [(0,), (1,)]
    assert order(((1,), 100), ((0,), 80)) == [(1,), (0,)]
    assert order(((2,), 110), ((1,), 100)) == order(((1,), 110), ((2,), 100)) == [(1,), (2,)]
    assert order(((0,), 40), ((2,), 60), ((1,), 50)) == [(2,), (1,), (0,)]


def test_points_that_are_hardly_off_are_no_second_motion() -> None:
    """A lens that is not quite known leaves tenths of a pixel; a person's steps leave more."""
    for shift_px, motions in ((0.4, 1), (2.0, 2)):
        seen = seen_points(RIG, TRUTH, 100, np.random.default_rng(7), sigma_px=0.04)
        askew = np.arange(len(seen.pair)) % 4 == 0
        off = np.where(askew[:, None], np.array([shift_px, 0.0]) / RIG.pairs[0].left.focal_px, 0.0)
        assert len(agreement_of(seen._replace(left=seen.left + off, right=seen.right + off)).hypotheses) == motions


def test_people_who_walk_through_all_views_are_a_second_motion() -> None:
    world = seen_points(RIG, TRUTH, 80, np.random.default_rng(1), sigma_px=0.2)
    people = seen_points(RIG, DOOR, 30, np.random.default_rng(2), sigma_px=0.2)
    agreement = agreement_of(joined(world, people))
    assert len(agreement.hypotheses) == 2
    assert distance(agreement.hypotheses[0].refined.cur_T_ref, TRUTH) < 5e-3
    assert distance(agreement.hypotheses[1].refined.cur_T_ref, DOOR) < 1e-2


def test_wrong_matches_are_no_second_motion() -> None:
    seen = seen_points(RIG, TRUTH, 80, np.random.default_rng(3), sigma_px=0.2, outlier_share=0.4)
    assert len(agreement_of(seen).hypotheses) == 1


def test_a_single_pair_has_nobody_to_contradict_it() -> None:
    seen = seen_points(RIG, TRUTH, 60, np.random.default_rng(4), sigma_px=0.2).of_pair(1)
    agreement = agreement_of(seen)
    assert len(agreement.hypotheses) == 1
    assert agreement.own == {}


def test_pair_report_has_the_pairs_own_error() -> None:
    quiet_px, loud_px = 0.15, 0.3
    quiet = seen_points(RIG, TRUTH, 200, np.random.default_rng(5), sigma_px=quiet_px).of_pair(0)
    loud = seen_points(RIG, TRUTH, 200, np.random.default_rng(6), sigma_px=loud_px).of_pair(1)
    seen = joined(quiet, loud)
    agreement = agreement_of(seen)
    assert len(agreement.hypotheses) == 1
    rows = {j: np.arange(200) for j in range(2)}
    frame = replace(TrackedFrame.empty(), ids=np.arange(200), ages=np.zeros(200, dtype=np.int64))
    for j, sigma_px in enumerate((quiet_px, loud_px)):
        report = pair_reports({j: frame}, Correspondences(seen, rows, {0: 200, 1: 200}), agreement, {})[j]
        assert report.inliers > 180
        assert report.rms_px == pytest.approx(sigma_px, rel=0.1)
        assert report.own_rms_px == pytest.approx(sigma_px, rel=0.1)


def test_a_pair_that_the_chosen_motion_does_not_explain_has_no_error_under_it() -> None:
    seen = mixed((TRUTH, 120), (DOOR, 60))
    agreement = agreement_of(seen)
    rows = {0: np.arange(120), 1: np.arange(60)}
    frame = replace(TrackedFrame.empty(), ids=np.arange(60), ages=np.zeros(60, dtype=np.int64))
    report = pair_reports({1: frame}, Correspondences(seen, rows, {0: 120, 1: 60}), agreement, {})[1]
    assert (report.inliers, report.rms_px) == (0, None)
    assert report.own_rms_px == pytest.approx(0.2, rel=0.15)


@pytest.mark.parametrize("second", [TRUTH, DOOR], ids=["one world", "a door"])
@pytest.mark.parametrize("seed", range(3))
def test_swapping_pairs_changes_only_their_names(second: Float, seed: int) -> None:
    """Other triples are sampled, so that motions agree as far as refinement converges: to a hundredth of a sigma."""
    seen = mixed((TRUTH, 90), (second, 60), seed)
    order = np.argsort(1 - seen.pair, kind="stable")
    columns: list[AnyArray] = [column[order] for column in seen]
    swapped = Observations(*columns)._replace(pair=1 - seen.pair[order])
    first, again = agreement_of(seen, seed), agreement_of(swapped, seed, RigArrays.of(RIG.with_pairs([1, 0])))
    assert [side.pairs for side in again.hypotheses] == [
        tuple(sorted(1 - j for j in side.pairs)) for side in first.hypotheses
    ]
    assert again.max_distance == pytest.approx(first.max_distance, rel=0.02)
    for one, other in zip(first.hypotheses, again.hypotheses, strict=True):
        assert_same(one.refined, other.refined)
        np.testing.assert_array_equal(other.refined.inlier, one.refined.inlier[order])
    assert again.own.keys() == {1 - j for j in first.own}
    for j, own in first.own.items():
        assert_same(own, again.own[1 - j])
        np.testing.assert_array_equal(again.own[1 - j].inlier, own.inlier)


def assert_same(one: Refined, other: Refined) -> None:
    sigmas = np.sqrt(np.diag(one.covariance))
    apart = se3_log(np.ascontiguousarray(one.cur_T_ref @ np.linalg.inv(other.cur_T_ref)))
    assert np.abs(apart / sigmas).max() < 0.01
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(other.covariance / scale, one.covariance / scale, atol=0.01)


# ------------------------------------------------------------------ quality


CONFIRMED = StereoShare(0.9, 0.12)


def measured(cur_T_ref: Float, inliers: int, sigma: float = 1e-4) -> RelativeMotion:
    covariance = sigma**2 * np.eye(6)
    return RelativeMotion(0, 50_000_000, se3_inverse(cur_T_ref), covariance, 0.3 * covariance, inliers)


def judged(
    motions: Sequence[RelativeMotion],
    max_distance: float,
    frozen_since_ns: int | None,
    stereo: StereoShare,
    noise: float = 0.5,
) -> tuple[RelativeMotion, Quality, str]:
    return motion_with_quality(
        [checked_hypothesis(motion, frozen_since_ns, stereo, noise) for motion in motions], max_distance
    )


def test_a_good_motion_is_left_as_it_is() -> None:
    motion, quality, reason = judged([measured(TRUTH, 200)], 5.0, None, CONFIRMED)
    assert quality is Quality.GOOD
    assert reason == ""
    assert np.array_equal(motion.covariance, measured(TRUTH, 200).covariance)


def test_the_covariance_covers_the_rival() -> None:
    """Whichever of the two motions is right, its turn and its shift are each within about a sigma."""
    motion, quality, reason = judged([measured(TRUTH, 100), measured(DOOR, 80)], 0.0, None, CONFIRMED)
    assert quality is Quality.WEAK
    assert "two motions are seen" in reason
    for right in (TRUTH, DOOR):
        error = se3_log(np.ascontiguousarray(right @ motion.reference_T_current))
        assert error @ np.linalg.solve(motion.covariance, error) < 2.05
    # Also where neither is: half of each view may be filled by what moves.
    error = se3_log(
        np.ascontiguousarray(transform([0.02, -0.03, 0.06], [0.02, -0.06, 0.05]) @ motion.reference_T_current)
    )
    assert error @ np.linalg.solve(motion.covariance, error) < 6.0
    few = judged([measured(TRUTH, 200), measured(DOOR, 12)], 0.0, None, CONFIRMED)
    assert few[1] is Quality.GOOD  # somebody far away


def test_few_points_are_believed_less_and_less() -> None:
    sigmas = [
        np.sqrt(np.trace(judged([measured(TRUTH, n)], 0.0, None, CONFIRMED)[0].covariance)) for n in (40, 29, 20, 12)
    ]
    assert sigmas == sorted(sigmas)
    assert sigmas[0] < 1e-3
    assert sigmas[-1] > 0.03  # as far as a person walks in the time
    assert judged([measured(TRUTH, 20)], 0.0, None, CONFIRMED)[1:] == (Quality.WEAK, "only 20 points")


@pytest.mark.parametrize(("noise", "factor"), [(0.2, 1.0), (1.0, 1.0), (1.5, 2.25), (2.5, 6.25)])
def test_errors_beyond_the_modelled_noise_count_twice(noise: float, factor: float) -> None:
    motion, quality, reason = judged([measured(TRUTH, 200)], 0.0, None, CONFIRMED, noise)
    np.testing.assert_allclose(motion.covariance, factor * measured(TRUTH, 200).covariance)
    assert quality is (Quality.WEAK if noise > 2.0 else Quality.GOOD)
    assert ("2.5 times worse" in reason) == (noise > 2.0)


def test_images_that_all_repeat_say_nothing_for_sure() -> None:
    motion, quality, reason = judged([measured(STILL, 300)], 0.0, -950_000_000, CONFIRMED)
    assert quality is Quality.WEAK
    assert "repeats" in reason
    assert np.sqrt(motion.covariance[3, 3]) == pytest.approx(1.0, rel=0.01)  # a metre in a second


def test_weakest_sigmas_are_those_of_the_weakest_directions() -> None:
    turned = transform([0.3, -0.2, 0.5], [0.0, 0.0, 0.0])[:3, :3]
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = turned @ np.diag([1e-6, 4e-6, 2e-6]) @ turned.T
    covariance[3:, 3:] = turned @ np.diag([9e-4, 1e-4, 1e-6]) @ turned.T
    assert replace(measured(TRUTH, 50), covariance=covariance).weakest_sigmas == pytest.approx((2e-3, 0.03))


def test_distance_and_weak_directions_enlarge_the_covariance() -> None:
    base = np.trace(measured(TRUTH, 200).covariance)
    assert np.trace(judged([measured(TRUTH, 200)], 36.0, None, CONFIRMED)[0].covariance) == pytest.approx(3.0 * base)
    weak = replace(measured(TRUTH, 200), covariance=np.diag([1e-8] * 5 + [0.01]))
    assert judged([weak], 0.0, None, CONFIRMED)[1] is Quality.WEAK
    random = random_transform(np.random.default_rng(0), 0.01, 0.01)
    assert judged([measured(random, 200)], 0.0, None, CONFIRMED)[1] is Quality.GOOD


def test_what_the_right_images_do_not_confirm_may_be_off_by_the_baseline() -> None:
    """As it is when the cables of left and right are swapped while the rig runs."""
    motion, quality, reason = judged([measured(TRUTH, 200)], 0.0, None, StereoShare(0.1, 0.12))
    assert quality is Quality.WEAK
    assert reason == "only 10 % of the corners are found in the right images"
    sigmas = np.sqrt(np.diag(motion.covariance))
    assert sigmas[3:].min() > 0.12
    assert sigmas[:3].min() > 0.02


def test_the_share_that_stereo_confirms_is_that_of_all_corners() -> None:
    def frame(with_depth: int, of: int) -> TrackedFrame:
        return replace(TrackedFrame.empty(), ids=np.arange(of), has_depth=np.arange(of) < with_depth)

    reference, current = {0: frame(90, 100), 1: frame(80, 100)}, {0: frame(60, 100), 1: frame(4, 50)}
    share_of_stereo = stereo_share(reference, current, [0.1, 0.2])
    assert share_of_stereo.share == pytest.approx((100 * 0.6 + 50 * 0.08) / 150)
    assert share_of_stereo.baseline_m == 0.2
    assert stereo_share({1: reference[1]}, current, [0.1, 0.2]).share == pytest.approx(0.08)
    assert stereo_share({**reference, 1: frame(0, 0)}, current, [0.1, 0.2]).share == pytest.approx(100 * 0.6 / 150)
    assert stereo_share({0: frame(0, 0)}, {0: frame(0, 0)}, [0.1, 0.2]).share == 0.0
    assert judged([measured(TRUTH, 200)], 0.0, None, StereoShare(0.13, 0.12))[1] is Quality.GOOD

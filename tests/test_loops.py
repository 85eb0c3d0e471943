"""Loop closures: resection across pairs, retrieval, masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from graphvio.arrays import Float, Int
from graphvio.config import Config
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.geometry import se3, se3_inverse, se3_log, so3_exp
from graphvio.optimization.loops.places import PairObserver
from graphvio.optimization.loops.resection import resect_features
from graphvio.optimization.loops.retrieval import candidates, describe, vocabulary
from graphvio.rig import StereoPair
from graphvio.simulation import default_rig

RIG = default_rig()
CONFIG = Config()
PIXEL_SIGMA = 0.5


def frame(pair: StereoPair, points: Float, stamp_ns: int, rng: np.random.Generator) -> TrackedFrame:
    """Points (N, 3) in body as a pair sees them, with noisy pixels; those out of view have no depth."""
    seen = []
    for camera in (pair.left, pair.right):
        in_camera = points @ camera.cam_T_body[:3, :3].T + camera.cam_T_body[:3, 3]
        pixels, inside = camera.project(in_camera)
        pixels = np.where(inside[:, None], pixels, 100.0) + PIXEL_SIGMA * rng.standard_normal(pixels.shape)
        seen.append((pixels, camera.unproject(pixels)[0], inside))
    (pixels, left, in_left), (right_pixels, right, in_right) = seen
    triangulated, covariances, _ = triangulate(left, right, pair.right_T_left, pair.left.focal_px, pair.right.focal_px)
    none = np.zeros(len(points), dtype=np.int64)
    return TrackedFrame(
        stamp_ns, np.arange(len(points)), none, pixels, left, right, right_pixels, triangulated, covariances,
        np.zeros((len(points), 2)), in_left & in_right, none,
    )  # fmt: skip


def scene(
    rng: np.random.Generator, crossing: tuple[int, int], count: int
) -> tuple[Float, dict[int, TrackedFrame], dict[int, TrackedFrame], Int]:
    """A motion after which pair b sees what pair a saw, the frames of both, and their matches (M, 2)."""
    a, b = (RIG.pairs[j] for j in crossing)
    shake = se3(so3_exp(rng.normal(0.0, 0.05, 3)), rng.normal(0.0, 0.2, 3))
    cur_T_ref = b.left.body_T_cam @ shake @ a.left.cam_T_body
    depth = rng.uniform(2.0, 8.0, count)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), np.ones(count)])
    in_left = rays * depth[:, None]
    in_body = in_left @ a.left.body_T_cam[:3, :3].T + a.left.body_T_cam[:3, 3]
    later = in_body @ cur_T_ref[:3, :3].T + cur_T_ref[:3, 3]
    then, now = frame(a, in_body, 1, rng), frame(b, later, 2, rng)
    rows = np.flatnonzero(then.has_depth & now.has_depth)
    return cur_T_ref, {crossing[0]: then}, {crossing[1]: now}, np.column_stack([rows, rows])


@pytest.mark.parametrize("crossing", [(0, 0), (1, 1), (0, 1), (1, 0)])
def test_resect_features_across_pairs_is_consistent(crossing: tuple[int, int]) -> None:
    """With two matches in five wrong, the error is within its covariance."""
    rng = np.random.default_rng([7, *crossing])
    squares = []
    for _ in range(8):
        true, then, now, rows = scene(rng, crossing, 200)
        wrong = rng.choice(len(rows), 2 * len(rows) // 5, replace=False)
        rows[wrong, 1] = rng.permutation(rows[wrong, 1])
        found = resect_features(RIG, then, now, {crossing: rows}, CONFIG, [1])
        assert found is not None
        assert found.pairs == (crossing,)
        error = se3_log(se3_inverse(true) @ found.cur_T_ref)
        assert np.linalg.norm(error[3:]) < 0.05
        in_body = se3_log(found.cur_T_ref @ se3_inverse(true))
        squares.append(in_body @ np.linalg.solve(found.covariance, in_body))
    assert np.mean(squares) < 15.0


def test_resect_features_uses_both_pairs() -> None:
    """The front pair sees what the back pair saw, and vice versa."""
    rng = np.random.default_rng(3)
    half_turn = RIG.pairs[1].left.body_T_cam @ RIG.pairs[0].left.cam_T_body
    points = rng.uniform(-6.0, 6.0, (4000, 3))
    points = points[np.linalg.norm(points, axis=1) > 2.0]
    later = points @ half_turn[:3, :3].T + half_turn[:3, 3]
    then = {j: frame(pair, points, 1, rng) for j, pair in enumerate(RIG.pairs)}
    now = {j: frame(pair, later, 2, rng) for j, pair in enumerate(RIG.pairs)}
    matches = {}
    for a, b in ((0, 1), (1, 0)):
        rows = np.flatnonzero(then[a].has_depth & now[b].has_depth)[:150]
        assert len(rows) > 20
        matches[a, b] = np.column_stack([rows, rows])
    found = resect_features(RIG, then, now, matches, CONFIG, [1])
    alone = resect_features(RIG, then, now, {(0, 1): matches[0, 1]}, CONFIG, [1])
    assert found is not None
    assert alone is not None
    assert found.pairs == ((0, 1), (1, 0))
    assert np.trace(found.covariance[3:, 3:]) < 0.5 * np.trace(alone.covariance[3:, 3:])
    assert np.linalg.norm(se3_log(se3_inverse(half_turn) @ found.cur_T_ref)[3:]) < 0.01


def test_resect_features_wrong_matches_give_none() -> None:
    rng = np.random.default_rng(11)
    _, then, now, rows = scene(rng, (0, 1), 200)
    rows[:, 1] = rng.permutation(rows[:, 1])
    assert resect_features(RIG, then, now, {(0, 1): rows}, CONFIG, [1]) is None
    assert resect_features(RIG, then, now, {(0, 1): rows[:5]}, CONFIG, [1]) is None


def test_candidates_are_images_of_the_same_place() -> None:
    """Half of the features of a place are new each time."""
    rng = np.random.default_rng(5)
    places = [rng.gamma(0.5, 40.0, (300, 128)) for _ in range(12)]

    def look(place: Float) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        again = np.concatenate([place[:150] + rng.normal(0.0, 4.0, (150, 128)), rng.gamma(0.5, 40.0, (150, 128))])
        lengths = np.linalg.norm(again, axis=1, keepdims=True)
        return np.asarray(np.clip(again / lengths * 512.0, 0.0, 255.0), dtype=np.uint8)

    images = [look(place) for place in places] + [look(place) for place in places]
    words = vocabulary(images, len(images), 0)
    assert np.array_equal(words, vocabulary(images, len(images), 0))
    vectors = np.array([describe(image, words) for image in images])
    found = candidates(vectors, np.arange(24), lambda earlier, later: True, 1)
    best = {later: earlier for earlier, later in found}
    assert [best[later] for later in range(12, 24)] == list(range(12))
    assert not describe(images[0][:0], words).any()


def test_candidates_are_allowed_and_ordered_by_similarity() -> None:
    """Of five images, the last two are of one place, which looks like the first by one of them."""
    vectors = np.array([[1.0, 0.0], [0.9, 0.4359], [0.2, 0.9798], [0.1, 0.995], [0.8, 0.6]], dtype=np.float32)
    place = np.array([0, 1, 2, 3, 3])

    def may(earlier: int, later: int) -> bool:
        return later - earlier > 1

    assert candidates(vectors, place, may, 2) == [(1, 3), (0, 3), (0, 2)]
    assert candidates(vectors, place, may, 1) == [(1, 3), (0, 2)]


def test_usable_masked_pixels_are_not(tmp_path: Path) -> None:
    pair = RIG.pairs[0]
    width, height = pair.left.size_px
    mask = np.full((height, width), 255, dtype=np.uint8)
    mask[:, : width // 2] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    masked = replace(pair, left=replace(pair.left, mask=tmp_path / "mask.png"))
    pixels = np.array([[0.25 * width, 100.0], [0.75 * width, 100.0], [-1.0, 100.0]])
    assert PairObserver(pair, CONFIG).usable(pixels).tolist() == [True, True, False]
    assert PairObserver(masked, CONFIG).usable(pixels).tolist() == [False, True, False]

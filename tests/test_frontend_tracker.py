"""One pair's tracks, on images of a textured wall that faces the cameras: where each point goes is known."""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import transform
from waves import picture, waves

from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.config import Config
from graphvio.config.stages import CornerConfig
from graphvio.frontend.depth.matching import StereoMatcher
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.imaging.lucas_kanade import build_pyramid
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.rig import Camera, StereoPair

WIDTH, HEIGHT = 320, 240
FOCAL, BASELINE, DISTANCE = 250.0, 0.1, 2.0
DISPARITY = FOCAL * BASELINE / DISTANCE
X, Y = np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT)))
FOLLOWED = ("flow", "edge", "masked_left", "crowded")
MATCHED = ("search", "alignment", "appearance", "corner", "left_right", "outside", "masked", "epipolar", "depth_range")


def rectified(left_mask: Path | None = None, right_mask: Path | None = None) -> StereoPair:
    intrinsics = np.array([FOCAL, FOCAL, 0.5 * WIDTH, 0.5 * HEIGHT])
    model = ("radial-tangential", (WIDTH, HEIGHT), intrinsics, np.zeros(5))
    right = transform([0.0, 0.0, 0.0], [BASELINE, 0.0, 0.0])
    return StereoPair(
        "pair", Camera("left", *model, np.eye(4), mask=left_mask), Camera("right", *model, right, mask=right_mask)
    )


def on_wall(pixels: Float, left_T_wall: Float) -> Float:
    """Points (N, 3) of the wall ``z = DISTANCE`` that pixels (N, 2) of the left camera see."""
    rays = np.column_stack([(pixels - [0.5 * WIDTH, 0.5 * HEIGHT]) / FOCAL, np.ones(len(pixels))])
    wall_T_left = np.linalg.inv(left_T_wall)
    ahead = rays @ wall_T_left[:3, :3].T
    depths = (DISTANCE - wall_T_left[2, 3]) / ahead[:, 2]
    return np.asarray(wall_T_left[:3, 3] + depths[:, None] * ahead)


def seen(points: Float, left_T_wall: Float) -> Float:
    moved = points @ left_T_wall[:3, :3].T + left_T_wall[:3, 3]
    return np.asarray(FOCAL * moved[:, :2] / moved[:, 2:] + [0.5 * WIDTH, 0.5 * HEIGHT])


@lru_cache(64)
def _texture(camera_T_wall: bytes) -> Float:
    """The wall without noise, as most tests see it from the same poses."""
    points = on_wall(np.column_stack([X.ravel(), Y.ravel()]), np.frombuffer(camera_T_wall).reshape(4, 4))
    scale = FOCAL / DISTANCE  # one pixel of wall at the start
    return waves(points[:, 0].reshape(X.shape) * scale, points[:, 1].reshape(X.shape) * scale)


def view(camera_T_wall: Float, seed: int, noise: float) -> Image:
    """What a camera sees of the wall."""
    return picture(
        _texture(camera_T_wall.tobytes()) + noise / 45.0 * np.random.default_rng(seed).standard_normal(X.shape)
    )


def views(left_T_wall: Float, seed: int = 0, noise: float = 1.5) -> tuple[Image, Image]:
    right_T_left = transform([0.0, 0.0, 0.0], [-BASELINE, 0.0, 0.0])
    return view(left_T_wall, 2 * seed, noise), view(right_T_left @ left_T_wall, 2 * seed + 1, noise)


def walk(frames: int) -> list[Float]:
    """``left_T_wall`` of a camera that turns slowly about its axis and approaches."""
    return [transform([0.0, 0.0, 0.015 * k], [0.002 * k, 0.0, -0.025 * k]) for k in range(frames)]


def followed(
    poses: list[Float],
    *,
    with_keyframe: bool,
    tracker: GroupTracker | None = None,
    replenished_at: tuple[int, ...] = (),
) -> list[TrackedFrame]:
    """Frames of a walk, some of them with new corners."""
    tracker = GroupTracker(rectified(), Config()) if tracker is None else tracker
    frames = []
    for k, pose in enumerate(poses):
        since_last = pose @ np.linalg.inv(poses[k - 1]) if k else None
        since_first = pose @ np.linalg.inv(poses[0]) if k and with_keyframe else None
        frame = tracker.observe(k, *views(pose, k), since_last, since_first)
        frames.append(tracker.replenish() if k in replenished_at else frame)
        if k == 0:
            tracker.keep_keyframe_patches()
    return frames


def test_observe_keeps_identities_and_counts_ages() -> None:
    replenished_at = (2, 4)
    frames = followed(walk(6), with_keyframe=True, replenished_at=replenished_at)
    added = [int((frame.ages == 0).sum()) for frame in frames]
    assert [k for k in range(1, 6) if added[k]] == list(replenished_at)
    for before, after in pairwise(frames):
        assert (np.diff(after.ids) > 0).all()
        old = np.isin(after.ids, before.ids)
        assert old.mean() > 0.6
        np.testing.assert_array_equal(after.ages[old], before.ages[np.isin(before.ids, after.ids)] + 1)
        assert (after.ages[~old] == 0).all()
        assert after.ids[~old].min(initial=10**9) > before.ids.max()  # no identity is given twice
    assert frames[-1].ages.max() == 5


def test_observe_measures_depths_of_a_wall() -> None:
    poses = walk(5)
    frame = followed(poses, with_keyframe=True)[-1]
    good = frame.has_depth
    assert good.mean() > 0.8
    points = on_wall(frame.pixels[good], poses[-1])
    depths = (points @ poses[-1][:3, :3].T + poses[-1][:3, 3])[:, 2]
    sigma = 0.3 * np.sqrt(frame.covariances[good, 2, 2])
    assert np.median(np.abs(frame.points[good, 2] - 1.0 / depths) / sigma) < 1.0


def test_keyframe_patches_prevent_drift() -> None:
    poses = walk(16)
    errors = {}
    for with_keyframe in (False, True):
        frames = followed(poses, with_keyframe=with_keyframe)
        first, last = frames[0], frames[-1]
        both, at_first, at_last = np.intersect1d(first.ids, last.ids, return_indices=True)
        assert len(both) > 12
        expected = seen(on_wall(first.pixels[at_first], poses[0]), poses[-1])
        errors[with_keyframe] = np.median(np.linalg.norm(last.pixels[at_last] - expected, axis=1))
    assert errors[True] < 0.1
    assert errors[True] < 0.6 * errors[False]


def test_observe_counts_every_rejection() -> None:
    frames = followed(walk(8), with_keyframe=True)
    for before, after in pairwise(frames):
        entered = int((before.frames_without_depth <= 3).sum())
        kept = int((after.ages > 0).sum())
        assert entered - kept == sum(after.rejected[name] for name in FOLLOWED)
        assert int((~after.has_depth).sum()) == sum(after.rejected[name] for name in MATCHED)
    assert set(frames[-1].rejected) == {*FOLLOWED, *MATCHED}


def test_new_corners_by_replenish_or_when_few_tracks_are_left() -> None:
    poses = walk(4)
    tracker = GroupTracker(rectified(), Config())
    first, second = followed(poses[:2], with_keyframe=True, tracker=tracker)
    assert np.isin(second.ids, first.ids).all()
    replenished = tracker.replenish()
    new = ~np.isin(replenished.ids, second.ids)
    assert new.any()
    np.testing.assert_array_equal(replenished.ids[~new], second.ids)
    cell_px = CornerConfig().cell_px(WIDTH)
    taken = {tuple(cell) for cell in (second.pixels[second.has_depth] // cell_px).astype(int)}
    # Sub-pixel precision may carry a corner by half a pixel into the next cell.
    inside = np.all(np.abs(replenished.pixels % cell_px - 0.5 * cell_px) < 0.5 * cell_px - 0.5, axis=1)
    assert not taken & {tuple(cell) for cell in (replenished.pixels[new & inside] // cell_px).astype(int)}
    tracker.drop(replenished.ids[8:])
    scarce = tracker.observe(2, *views(poses[2], 2), poses[2] @ np.linalg.inv(poses[1]), None)
    assert len(scarce.ids) > 20
    assert not np.isin(replenished.ids[8:], scarce.ids).any()


def test_observe_leaves_earlier_frames_unchanged() -> None:
    """Frames are the front-end's references: following their tracks, foreseen or not, must not move them."""
    poses = walk(2)
    for predicted in (None, poses[1] @ np.linalg.inv(poses[0])):
        tracker = GroupTracker(rectified(), Config())
        first = tracker.observe(0, *views(poses[0]), None, None)
        tracker.keep_keyframe_patches()
        held: dict[str, AnyArray] = {name: v.copy() for name, v in vars(first).items() if isinstance(v, np.ndarray)}
        second = tracker.observe(1, *views(poses[1], 1), predicted, predicted)
        _, then, now = np.intersect1d(first.ids, second.ids, return_indices=True)
        assert np.abs(second.pixels[now] - held["pixels"][then]).max() > 0.5
        for name, value in held.items():
            np.testing.assert_array_equal(getattr(first, name), value, err_msg=name)


def test_drop_removes_tracks() -> None:
    tracker = GroupTracker(rectified(), Config())
    poses = walk(2)
    first = tracker.observe(0, *views(poses[0]), None, None)
    tracker.drop(first.ids[::2])
    second = tracker.observe(1, *views(poses[1]), None, None)
    assert not np.isin(first.ids[::2], second.ids).any()
    assert np.isin(first.ids[1::2], second.ids).mean() > 0.6


def test_observe_with_a_wrong_prediction_loses_few_tracks() -> None:
    poses = walk(2)
    tracker = GroupTracker(rectified(), Config())
    first = tracker.observe(0, *views(poses[0]), None, None)
    wrong = transform([0.0, 0.03, 0.0], [0.0, 0.0, 0.0])  # by 8 pixels: too far for the finest levels alone
    second = tracker.observe(1, *views(poses[1], 1), wrong, None)
    assert np.isin(first.ids, second.ids).mean() > 0.7


def test_observe_through_a_fast_turn_finds_the_tracks() -> None:
    """By 14 degrees from one image to the next, as a head may turn at 5 rad/s: 60 pixels, of 320."""
    turned = transform([0.0, 0.24, 0.0], [0.0, 0.0, 0.0])
    shares, errors_px = [], []
    for predicted in (None, turned @ transform([0.01, -0.01, 0.01], [0.01, 0.0, 0.02])):  # not quite right
        tracker = GroupTracker(rectified(), Config())
        first = tracker.observe(0, *views(np.eye(4)), None, None)
        tracker.keep_keyframe_patches()
        second = tracker.observe(1, *views(turned, 1), predicted, predicted)
        _, then, now = np.intersect1d(first.ids, second.ids, return_indices=True)
        true = seen(on_wall(first.pixels, np.eye(4)), turned)
        in_view = ((true > 15.0) & (true < [WIDTH - 15.0, HEIGHT - 15.0])).all(axis=1)
        off_px = np.hypot(*(second.pixels[now] - true[then]).T)
        shares.append(float(np.sum(off_px < 0.5) / in_view.sum()))
        errors_px.append(float(np.median(off_px)) if len(off_px) else np.inf)
    assert shares[0] > 0.6  # by those that are found anyway, and by the shift of the whole image
    assert shares[1] > 0.8
    assert errors_px[1] < 0.2


def mask_of(allowed: Bool, path: Path) -> Path:
    cv2.imwrite(str(path), 255 * allowed.astype(np.uint8))
    return path


def test_left_mask_excludes_corners_and_tracks(tmp_path: Path) -> None:
    pair = rectified(left_mask=mask_of(X < 200, tmp_path / "left.png"))
    for frame in followed(walk(4), with_keyframe=True, tracker=GroupTracker(pair, Config())):
        assert len(frame.ids) > 10
        assert frame.pixels[:, 0].max() < 200.5 - 8.0  # no pixel of its patch of 15


def test_masked_pixels_do_not_influence_tracks(tmp_path: Path) -> None:
    """Corners are the same, so are those with depth, and their points to a millimetre."""
    pair = rectified(mask_of(X < 200, tmp_path / "left.png"), mask_of(X < 200, tmp_path / "right.png"))
    results = []
    for grey in (0, 255):
        images = [np.where(X < 200, image, grey).astype(np.uint8) for image in views(np.eye(4))]
        results.append(GroupTracker(pair, Config()).observe(0, images[0], images[1], None, None))
    np.testing.assert_array_equal(results[0].pixels, results[1].pixels)
    np.testing.assert_array_equal(results[0].has_depth, results[1].has_depth)
    known = results[0].has_depth
    assert known.sum() > 50
    np.testing.assert_allclose(results[0].points[known], results[1].points[known], atol=1e-3)


def test_right_mask_excludes_matches(tmp_path: Path) -> None:
    pair = rectified(right_mask=mask_of(X < 200, tmp_path / "right.png"))
    images = views(np.eye(4))
    frame = GroupTracker(pair, Config()).observe(0, *images, None, None)
    whole = GroupTracker(rectified(), Config()).observe(0, *images, None, None)
    np.testing.assert_array_equal(frame.pixels, whole.pixels)
    hidden = frame.pixels[:, 0] - DISPARITY > 200.7 - 8.0
    clear = frame.pixels[:, 0] - DISPARITY < 198.5 - 8.0
    assert hidden.sum() > 5
    assert not frame.has_depth[hidden].any()
    np.testing.assert_array_equal(frame.has_depth[clear], whole.has_depth[clear])
    assert frame.rejected["masked"] == int((whole.has_depth & ~frame.has_depth).sum())


def test_match_of_no_corner_in_the_right_image_is_rejected() -> None:
    left, right = views(np.eye(4))
    pair = rectified()
    matcher = StereoMatcher(pair, Config(), np.ones(left.shape, dtype=bool))
    x, y = np.meshgrid(np.arange(60.0, 280.0, 30.0), np.arange(40.0, 210.0, 30.0))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays, _ = pair.left.unproject(pixels)
    n = len(pixels)
    fainter = np.round(128.0 + 0.6 * (right.astype(float) - 128.0)).astype(np.uint8)
    rejected = []
    for seen_right in (right, fainter):
        images = build_pyramid(left, 2), build_pyramid(seen_right, 2)
        matches = matcher.match(*images, pixels, rays, np.full(n, np.nan), np.zeros((n, 2)), 6.0)
        rejected.append(matches.rejected["corner"])
        assert matches.good.sum() + sum(matches.rejected.values()) == n
    assert rejected[0] < 0.15 * n
    assert rejected[1] > 2 * rejected[0]


@pytest.mark.parametrize("lower_px", [2.0, -4.5, 7.0])
def test_match_margin_finds_matches_beside_wrong_epipolar_lines(lower_px: float) -> None:
    pair, images = rectified(), views(np.eye(4))
    lower = replace(pair.right, intrinsics=pair.right.intrinsics + np.array([0.0, 0.0, 0.0, lower_px]))
    exact = GroupTracker(pair, Config()).observe(0, *images, None, None)
    tracker = GroupTracker(pair, Config())
    tracker.recalibrate(replace(pair, right=lower), 0.0)
    strict = tracker.observe(0, *images, None, None)
    tracker.recalibrate(replace(pair, right=lower), 3.0)
    wide = tracker.observe(1, *images, None, None)
    assert tracker.are_lines_off == (abs(lower_px) > 3.0)
    assert strict.has_depth.mean() < 0.1
    assert wide.has_depth.mean() > 0.7 * exact.has_depth.mean()
    off_px = wide.pixels - np.array([DISPARITY, 0.0]) - wide.right_pixels
    assert np.median(np.abs(off_px[wide.has_depth])) < 0.1


def test_match_margin_of_a_repeating_texture_leaves_the_epipolar_lines_where_they_are() -> None:
    """Another row of the pattern is as like, and at times less ambiguous."""
    rng, squares = np.random.default_rng(4), np.where((X // 12 + Y // 12) % 2, 60.0, 190.0)
    noisy = (squares + rng.normal(0.0, 4.0, X.shape) for _ in range(2))
    left, right = (np.clip(image, 0, 255).astype(np.uint8) for image in noisy)
    tracker = GroupTracker(rectified(), Config())
    tracker.recalibrate(rectified(), 3.0)
    tracker.observe(0, left, right, None, None)
    assert not tracker.are_lines_off


# ------------------------------------------------------------------ low light


def half_blank(brightness: float, noise: float, seed: int = 0) -> Image:
    """Texture on the left, a blank wall on the right."""
    light = 128.0 + 45.0 * np.where(X < 160, waves(X, Y), 0.0)
    white = noise * np.random.default_rng(seed).standard_normal(X.shape)
    return np.asarray(np.clip(np.round(brightness * light + white), 0, 255), dtype=np.uint8)


@pytest.mark.parametrize("noise", [0.3, 0.7])
def test_weak_corners_in_low_light_are_above_the_noise(noise: float) -> None:
    dark = half_blank(0.1, noise)
    frame = GroupTracker(rectified(), Config()).observe(0, dark, dark, None, None)
    plain = GroupTracker(rectified(), Config(corners=CornerConfig(scarce_share=0.0)))
    plain.observe(0, dark, dark, None, None)
    assert len(plain.replenish().ids) < 6  # strong ones alone
    assert np.sum(frame.pixels[:, 0] < 165) > 12
    assert np.sum(frame.pixels[:, 0] > 170) <= 1


def test_weak_corners_are_tracked_and_matched() -> None:
    poses = walk(4)
    tracker = GroupTracker(rectified(), Config())
    for k, pose in enumerate(poses):
        left, right = views(pose, k, noise=3.0)
        left, right = (np.round(0.1 * image).astype(np.uint8) for image in (left, right))
        frame = tracker.observe(k, left, right, None, None)
    assert np.sum(frame.ages == 3) > 10
    assert frame.has_depth.mean() > 0.5


def test_weak_corners_are_not_added_to_a_rich_image() -> None:
    frames = []
    for share in (0.0, CornerConfig().scarce_share):
        tracker = GroupTracker(rectified(), Config(corners=CornerConfig(scarce_share=share)))
        frame = tracker.observe(0, *views(np.eye(4)), None, None)
        frames.append(frame if len(frame.ids) else tracker.replenish())
    np.testing.assert_array_equal(frames[0].pixels, frames[1].pixels)

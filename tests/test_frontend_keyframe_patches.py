"""A keyframe's patches, found again in views of a slanted wall whose places are known."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import transform
from waves import picture, waves

from graphvio.arrays import Float, Image
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.tracking.keyframe_patches import KeyframePatches
from graphvio.rig import Camera, SingleCamera, StereoPair

WIDTH, HEIGHT, FOCAL, BASELINE_M = 320, 240, 250.0, 0.1
CENTRE = np.array([0.5 * WIDTH, 0.5 * HEIGHT])
WALL = np.array([0.55, 0.15, 0.6])  # inverse depth of a ray [x, y, 1] is its product with this: a wall seen askew
ALONG_WALL = np.linalg.svd(WALL[None])[2][1:]  # (2, 3) two directions in it
X, Y = np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT)))
MOTION = transform([0.01, 0.02, -0.03], [0.1, 0.02, -0.3])  # left_T_left_keyframe
WINDOW_PX, MIN_GRADIENT = 15, 1.0


def pair() -> StereoPair:
    model = ("radial-tangential", (WIDTH, HEIGHT), np.array([FOCAL, FOCAL, *CENTRE]), np.zeros(5))
    return StereoPair(
        "pair", Camera("left", *model, np.eye(4)), Camera("right", *model, transform([0, 0, 0], [BASELINE_M, 0, 0]))
    )


def view(camera_T_first: Float) -> Image:
    """The wall as a camera sees it."""
    rays = np.column_stack([(X.ravel() - CENTRE[0]) / FOCAL, (Y.ravel() - CENTRE[1]) / FOCAL, np.ones(X.size)])
    first_T_camera = np.linalg.inv(camera_T_first)
    ahead = rays @ first_T_camera[:3, :3].T
    depths = (1.0 - first_T_camera[:3, 3] @ WALL) / (ahead @ WALL)
    places = (first_T_camera[:3, 3] + depths[:, None] * ahead) @ ALONG_WALL.T
    u, v = 150.0 * places.T.reshape(2, HEIGHT, WIDTH)
    return picture(waves(u, v) + 0.03 * np.random.default_rng(0).standard_normal(X.shape))


def tracks() -> TrackedFrame:
    """A grid of points on the wall, with what stereo matching would say of them."""
    x, y = np.meshgrid(np.arange(110.0, 231.0, 15.0), np.arange(60.0, 181.0, 15.0))
    pixels = np.column_stack([x.ravel(), y.ravel()]) + 0.3
    n = len(pixels)
    rays = (pixels - CENTRE) / FOCAL
    return replace(
        TrackedFrame.empty(),
        ids=10 + 2 * np.arange(n),
        ages=np.zeros(n, dtype=np.int64),
        pixels=pixels,
        left_rays=rays,
        right_rays=rays,
        points=np.column_stack([rays, rays @ WALL[:2] + WALL[2]]),
        covariances=np.zeros((n, 3, 3)),
        slopes=np.tile(BASELINE_M * WALL[:2], (n, 1)),
        has_depth=np.ones(n, dtype=bool),
        frames_without_depth=np.zeros(n, dtype=np.int64),
    )


def seen_after(frame: TrackedFrame, left_T_left_keyframe: Float) -> Float:
    rays = np.column_stack([frame.left_rays, np.ones(len(frame.ids))])
    points = rays / (rays @ WALL)[:, None] @ left_T_left_keyframe[:3, :3].T + left_T_left_keyframe[:3, 3]
    return np.asarray(FOCAL * points[:, :2] / points[:, 2:] + CENTRE)


def placed(frame: TrackedFrame) -> KeyframePatches:
    patches = KeyframePatches(pair(), WINDOW_PX)
    patches.take(frame, view(np.eye(4)))
    return patches


def errors_px(frame: TrackedFrame, slopes: Float) -> tuple[Float, float]:
    """Errors of the patches that were found in a later view, and how many were."""
    truth = seen_after(frame, MOTION)
    guess = truth + np.random.default_rng(1).uniform(-0.5, 0.5, truth.shape)
    pixels, found = placed(replace(frame, slopes=slopes)).find(frame.ids, guess, view(MOTION), MOTION, MIN_GRADIENT)
    np.testing.assert_array_equal(pixels[~found], guess[~found])
    return np.linalg.norm(pixels - truth, axis=1)[found], float(found.mean())


def test_find_on_a_slanted_wall_needs_its_slope() -> None:
    frame = tracks()
    known, found = errors_px(frame, frame.slopes)
    unknown, _ = errors_px(frame, np.zeros_like(frame.slopes))
    assert found > 0.9
    assert np.median(known) < 0.04
    assert np.median(unknown) > 3.0 * np.median(known)


def test_find_of_unknown_tracks_returns_the_guess() -> None:
    frame = tracks()
    frame = replace(frame, has_depth=np.arange(len(frame.ids)) % 3 > 0)
    strangers = np.concatenate([[3], frame.ids[:5] + 1, [10**9]])
    ids = np.sort(np.concatenate([frame.ids, strangers]))
    guess = np.full((len(ids), 2), 100.0)
    own = np.isin(ids, frame.ids)
    guess[own] = frame.pixels
    pixels, found = placed(frame).find(ids, guess, view(np.eye(4)), np.eye(4), MIN_GRADIENT)
    assert not found[~own].any()
    assert not found[own][~frame.has_depth].any()
    assert found[own][frame.has_depth].mean() > 0.95
    np.testing.assert_array_equal(pixels[~found], guess[~found])


@pytest.mark.parametrize("frame", [None, TrackedFrame.empty()], ids=["never placed", "no tracks"])
def test_find_without_patches_finds_nothing(frame: TrackedFrame | None) -> None:
    patches = KeyframePatches(pair(), WINDOW_PX) if frame is None else placed(frame)
    guess = np.array([[100.0, 80.0]])
    pixels, found = patches.find(np.array([0]), guess, view(np.eye(4)), np.eye(4), MIN_GRADIENT)
    np.testing.assert_array_equal(pixels, guess)
    assert not found.any()


def test_find_of_no_tracks_returns_empty() -> None:
    none = np.zeros((0, 2))
    pixels, found = placed(tracks()).find(np.zeros(0, dtype=np.int64), none, view(np.eye(4)), np.eye(4), MIN_GRADIENT)
    assert pixels.shape == (0, 2)
    assert found.shape == (0,)


def test_find_with_a_prediction_that_hides_the_wall_finds_nothing() -> None:
    frame = tracks()
    away = transform([0.0, 0.0, 0.0], [0.0, 0.0, -50.0])
    _, found = placed(frame).find(frame.ids, frame.pixels, view(np.eye(4)), away, MIN_GRADIENT)
    assert not found.any()


# ------------------------------------------------------------------ slants that a single camera sees by its motion

HALF_WAY = transform([0.005, 0.01, -0.015], [0.06, 0.01, -0.15])


def by_one_camera(frame: TrackedFrame, image: Image) -> KeyframePatches:
    patches = KeyframePatches(SingleCamera(pair().left), WINDOW_PX)
    patches.take(replace(frame, is_single=True), image)
    return patches


def median_error_px(patches: KeyframePatches, frame: TrackedFrame, motion: Float, before: Float) -> float:
    """Median error of patches found after a motion since their keyframe, which was at another place ``before``."""
    truth = seen_after(tracks(), motion @ before)
    pixels, found = patches.find(frame.ids, truth + 0.2, view(motion @ before), motion, MIN_GRADIENT)
    assert found.mean() > 0.7
    return float(np.median(np.linalg.norm(pixels - truth, axis=1)[found]))


def test_find_by_a_single_camera_learns_the_slant_on_the_way() -> None:
    frame, image = tracks(), view(np.eye(4))
    at_once, on_the_way = by_one_camera(frame, image), by_one_camera(frame, image)
    median_error_px(on_the_way, frame, HALF_WAY, np.eye(4))
    learnt = median_error_px(on_the_way, frame, MOTION, np.eye(4))
    assert learnt < 0.05
    assert median_error_px(at_once, frame, MOTION, np.eye(4)) > 2.0 * learnt


@pytest.mark.parametrize("is_known", [True, False])
def test_take_hands_slants_on_to_the_next_keyframe(is_known: bool) -> None:
    """Where the motion between the keyframes is known; else surfaces are taken to face the camera again."""
    frame, onwards = tracks(), MOTION @ np.linalg.inv(HALF_WAY)
    patches = by_one_camera(frame, view(np.eye(4)))
    median_error_px(patches, frame, HALF_WAY, np.eye(4))
    pixels = seen_after(frame, HALF_WAY)
    rays = (pixels - CENTRE) / FOCAL
    depth = HALF_WAY[2, :3] @ np.column_stack([frame.left_rays, np.ones(len(rays))]).T / frame.points[:, 2]
    points = np.column_stack([rays, 1.0 / (depth + HALF_WAY[2, 3])])
    later = replace(frame, pixels=pixels, left_rays=rays, points=points)
    patches.take(later, view(HALF_WAY), HALF_WAY if is_known else None)
    error_px = median_error_px(patches, later, onwards, HALF_WAY)
    assert error_px < 0.04 if is_known else error_px > 0.05

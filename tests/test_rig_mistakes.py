"""Pairs whose images are exchanged or whose transforms are inverted are reported, and no others."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from graphvio import FrameSet, Odometry, open_source
from graphvio.arrays import Image
from graphvio.geometry import se3_inverse
from graphvio.measurements.events import EventKind
from graphvio.rig import Rig
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw


def mistaken_in(rig: Rig, framesets: list[FrameSet]) -> tuple[list[str], list[str]]:
    """The names in events and warnings of a run without the IMU."""
    odometry = Odometry(rig.without_imu())
    for frameset in framesets:
        odometry.process(frameset)
    events = [each for each in odometry.take_events() if each.kind == EventKind.RIG_MISTAKEN]
    warnings = [each for each in odometry.rig_warnings if "match only if" in each]
    return [each.detail.split(":")[0] for each in events], [each.split(":")[0] for each in warnings]


@pytest.fixture(scope="module")
def walked(room_walk: Path) -> tuple[Rig, list[FrameSet]]:
    """The rig and one and a half seconds of the walk."""
    source = open_source(room_walk, from_s=1.0, to_s=2.5)
    return source.rig, [each for each in source if isinstance(each, FrameSet)]


def with_exchanged(framesets: list[FrameSet], pairs: set[int]) -> list[FrameSet]:
    """The framesets with left and right of some pairs exchanged."""
    return [
        FrameSet(each.stamp_ns, {j: images[::-1] if j in pairs else images for j, images in each.images.items()})
        for each in framesets
    ]


def of_one_pair(framesets: list[FrameSet]) -> list[FrameSet]:
    """The framesets with the images of the first pair only."""
    return [FrameSet(each.stamp_ns, {0: each.images[0]}) for each in framesets]


@pytest.mark.parametrize("pairs", [set(), {0}, {1}, {0, 1}])
def test_exchanged_pairs_are_named_once(walked: tuple[Rig, list[FrameSet]], pairs: set[int]) -> None:
    rig, framesets = walked
    names = [rig.pairs[j].name for j in sorted(pairs)]
    assert mistaken_in(rig, with_exchanged(framesets, pairs)) == (names, names)


def test_one_exchanged_pair_alone_is_named(walked: tuple[Rig, list[FrameSet]]) -> None:
    rig, framesets = walked
    one = rig.with_pairs([0])
    assert mistaken_in(one, of_one_pair(with_exchanged(framesets, {0})))[1] == [one.pairs[0].name]
    assert mistaken_in(one, of_one_pair(framesets)) == ([], [])


def test_warning_ends_when_images_are_right_again(walked: tuple[Rig, list[FrameSet]]) -> None:
    rig, framesets = walked
    events, warnings = mistaken_in(rig, with_exchanged(framesets[:15], {1}) + framesets[15:])
    assert events == [rig.pairs[1].name]
    assert warnings == []


def test_inverted_transforms_are_named(walked: tuple[Rig, list[FrameSet]]) -> None:
    rig, framesets = walked
    inverted = rig.with_cameras(lambda camera: replace(camera, body_T_cam=se3_inverse(camera.body_T_cam)))
    odometry = Odometry(inverted.with_pairs([0]).without_imu())
    for frameset in of_one_pair(framesets):
        odometry.process(frameset)
    (warning,) = [each for each in odometry.rig_warnings if "match only if" in each]
    assert "body_T_cam of both cameras is inverted" in warning
    assert "exchanged" not in warning


@cache
def waves(shift_px: float) -> Image:
    """An image of vertical waves, which match at any multiple of their length, with some rows."""
    x, y = np.meshgrid(np.arange(320.0) + shift_px, np.arange(240.0))
    return np.asarray(np.clip(128.0 + 60.0 * np.sin(x) + 40.0 * np.sin(0.3 * y), 0, 255), dtype=np.uint8)


def other_images(kind: str, images: tuple[Image, ...]) -> tuple[Image, ...]:
    """Images of a pair that do not match, or match as well one way as the other."""
    left, right = images
    return {
        "dark": (left // 64, right // 64),
        "far away": (left, left),
        "not of one scene": (left, np.ascontiguousarray(right[::-1, ::-1])),
        "one is black": (left, np.zeros_like(right)),
        "upside down": (np.ascontiguousarray(left[::-1]), right),
        "waves": (waves(0.0), waves(1.0)),
    }[kind]


@pytest.mark.parametrize("kind", ["dark", "far away", "not of one scene", "one is black", "upside down", "waves"])
def test_images_that_do_not_match_have_no_mistake(walked: tuple[Rig, list[FrameSet]], kind: str) -> None:
    rig, framesets = walked
    changed = [FrameSet(each.stamp_ns, {0: other_images(kind, each.images[0])}) for each in framesets]
    assert mistaken_in(rig.with_pairs([0]), changed) == ([], [])


@pytest.mark.parametrize("seed", range(3))
def test_wrong_calibration_is_no_mistake(walked: tuple[Rig, list[FrameSet]], seed: int) -> None:
    rig, framesets = walked
    written = draw(rig, CalibrationErrorSizes.of_level(3), seed).written_rig
    assert mistaken_in(written, framesets) == ([], [])

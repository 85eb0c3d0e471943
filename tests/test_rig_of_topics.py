"""Topics that make a rig, also if a recording has several of one camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import write_euroc
from test_bags import Message, bag, messages
from test_sessions import same

from graphvio import FrameSet, ImuSample, open_source
from graphvio.sessions import cdr
from graphvio.sessions.messages import COMPRESSED, IMAGE, IMU, compressed_image, stamp_of
from graphvio.sessions.rig_of_topics import stereo_topics
from graphvio.sources.description import describe

pytest.importorskip("mcap")
pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("topics") / "walk", frames=4, pairs=1)


def of_one_camera(*kinds: str) -> list[str]:
    return [f"/camera/{side}/{kind}" for side in ("infra1", "infra2") for kind in kinds]


@pytest.mark.parametrize(
    ("kinds", "taken"),
    [
        (["image_rect_raw", "image_rect_raw/compressed"], "image_rect_raw"),
        (["image_rect_raw/compressed"], "image_rect_raw/compressed"),
        (["image_raw", "image_rect"], "image_raw"),
        (["image_rect_color", "image_color"], "image_color"),
        (["image_raw/compressed", "image_rect"], "image_raw/compressed"),
        (["image", "image/compressed", "image/theora"], "image"),
        (["image_rect"], "image_rect"),
    ],
)
def test_stereo_topics_uses_one_of_several_topics_of_a_camera(kinds: list[str], taken: str) -> None:
    expected = {"camera": (f"/camera/infra1/{taken}", f"/camera/infra2/{taken}")}
    assert stereo_topics(of_one_camera(*kinds)) == expected
    assert stereo_topics(of_one_camera(*kinds)[::-1]) == expected


def test_stereo_topics_uses_topics_that_both_cameras_have() -> None:
    names = ["/rig/left/image_raw", "/rig/left/image_raw/compressed", "/rig/right/image_raw/compressed"]
    assert stereo_topics(names) == {"rig": ("/rig/left/image_raw/compressed", "/rig/right/image_raw/compressed")}


def test_stereo_topics_gives_pairs_distinct_names() -> None:
    names = [f"/rig/{side}/image_raw" for side in ("left", "right", "infra1", "infra2")]
    assert set(stereo_topics(names)) == {"rig-left", "rig-infra1"}
    names = [f"/rig/image_cam{number}" for number in range(4)]
    assert set(stereo_topics(names)) == {"rig-image_cam0", "rig-image_cam2"}
    names = [f"/cam{number}/image_raw" for number in range(4)]
    assert set(stereo_topics(names)) == {"cam0", "cam2"}


def with_compressed(made: list[Message]) -> list[Message]:
    found = []
    for topic, type_name, logged_ns, data in made:
        found.append((topic, type_name, logged_ns, data))
        if type_name == IMAGE:
            message = cdr.decode(data, IMAGE)
            pixels = np.asarray(message.data).reshape(message.height, message.width)
            png = cv2.imencode(".png", 255 - pixels)[1].tobytes()
            packed = compressed_image(stamp_of(message.header), message.header.frame_id, png)
            found.append((f"{topic}/compressed", COMPRESSED, logged_ns, cdr.encode(packed)))
    return found


@pytest.mark.parametrize("kind", ["ros1", "mcap file"])
def test_raw_images_are_preferred_to_compressed_ones(kind: str, recording: Path, tmp_path: Path) -> None:
    made = [message for message in messages(recording, tmp_path) if message[0] != "/graphvio/rig"]
    path = bag(kind, with_compressed(made), tmp_path)
    source = open_source(path)
    (pair,) = source.rig.pairs
    assert (pair.name, pair.left.name, pair.right.name) == ("pair0", "/pair0/left/image_raw", "/pair0/right/image_raw")
    framesets = [measurement for measurement in source if isinstance(measurement, FrameSet)]
    expected = [measurement for measurement in open_source(recording) if isinstance(measurement, FrameSet)]
    for one, other in zip(framesets, expected, strict=True):
        same(one, other)
    assert [each.first for each in describe(path).synchronisation] == ["pair0 left"]


def test_first_of_several_imus_is_used_and_reported(
    recording: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = messages(recording, tmp_path)
    other = []
    for _, type_name, logged_ns, data in made:
        if type_name == IMU:
            message = cdr.decode(data, IMU)
            message.angular_velocity = replace(message.angular_velocity, x=1.0)
            other.append(("/a/imu", IMU, logged_ns, cdr.encode(message)))
    path = bag("mcap file", [*made, *other], tmp_path)
    source = open_source(path)
    assert source.faults.counts["imu_several"] == 1
    assert "has samples on /a/imu, /imu; the first is used" in caplog.text
    assert all(measurement.angular_velocity[0] == 1.0 for measurement in source if isinstance(measurement, ImuSample))
    chosen = open_source(path, topics={"imu": "/imu"})
    assert "imu_several" not in chosen.faults.counts
    assert all(measurement.angular_velocity[0] != 1.0 for measurement in chosen if isinstance(measurement, ImuSample))

"""Topics that make a rig, also if a recording has several of one camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import LENSES, small_rig, with_lens, write_euroc
from test_bags import Message, bag, messages
from test_sessions import same

from graphvio import FrameSet, ImuSample, open_source
from graphvio.errors import RigError
from graphvio.sessions import cdr
from graphvio.sessions.messages import COMPRESSED, IMAGE, IMU, camera_info, compressed_image, stamp_of
from graphvio.sessions.rig_of_topics import _camera, stereo_topics
from graphvio.sources.description import describe

pytest.importorskip("mcap")
pytest.importorskip("rosbags")


@pytest.mark.parametrize("model", LENSES)
def test_camera_info_has_the_lens(model: str) -> None:
    expected = with_lens(small_rig(1), model).cameras[0]
    message = camera_info(0, expected)
    ros = {"rational": "rational_polynomial"}.get(model, model)
    assert (message.distortion_model, len(message.d)) == (ros, len(LENSES[model]))
    camera = _camera("cam0", message, expected.body_T_cam)
    assert camera.model == model
    np.testing.assert_array_equal(camera.intrinsics, expected.intrinsics)
    np.testing.assert_array_equal(camera.distortion, expected.distortion)


def test_camera_info_of_eight_coefficients_may_be_of_five() -> None:
    message = camera_info(0, with_lens(small_rig(1), "rational").cameras[0])
    message.d[5:] = 0.0
    assert _camera("cam0", message, np.eye(4)).model == "radial-tangential"
    message.d = np.append(message.d, np.zeros(6))
    assert _camera("cam0", message, np.eye(4)).model == "radial-tangential"
    message.d[8] = 0.1  # thin prism
    with pytest.raises(RigError, match=r"cam0: its camera_info has 14 distortion coefficients; at most 8 are known"):
        _camera("cam0", message, np.eye(4))
    message.d, message.distortion_model = np.full(8, 0.01), "plumb_bob"
    with pytest.raises(RigError, match=r"camera cam0: has 8 distortion coefficients, and radial-tangential has 5"):
        _camera("cam0", message, np.eye(4))


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

"""Masks of images: by a function, from files beside the images, from topics; and those of cameras."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recordings import noise_image, small_rig, write_euroc, write_image

from graphvio import FrameSet, Odometry, RigError, Trajectory, load_trajectory, open_source
from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.errors import MeasurementError
from graphvio.evaluation import evaluate
from graphvio.frontend.imaging.images import ImageMask, UsablePixels, checked
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.sensors import Measurement
from graphvio.rig import Camera
from graphvio.sessions.euroc_writer import EurocWriter
from graphvio.sessions.topics import ImageFormat
from graphvio.sessions.writer import SessionWriter
from graphvio.sources import Source


def estimates_of(
    walk: Path, image_mask: ImageMask | None, frames: int | None = None, pairs: Sequence[int] = (0, 1)
) -> Iterator[Estimate]:
    source = open_source(walk, open_source(walk).rig.with_pairs(pairs))
    odometry = Odometry(source.rig, image_mask=image_mask)
    estimates = (estimate for estimate in map(odometry.process, source) if estimate is not None)
    yield from itertools.islice(estimates, frames)


def person(image: Image) -> Bool:
    """A third of the image, at a place that its own grey values choose, so that it jumps about."""
    mask = np.ones(image.shape, dtype=bool)
    width = image.shape[1] // 3
    left = int(image[0].sum()) % (image.shape[1] - width)
    mask[:, left : left + width] = False
    return mask


def test_masked_pixels_hold_no_tracks(room_walk: Path) -> None:
    masks: dict[int, dict[str, Bool]] = {}
    source = open_source(room_walk)
    odometry = Odometry(source.rig, image_mask=lambda camera, image: person(image))
    for measurement in itertools.islice(source, 400):
        if isinstance(measurement, FrameSet):
            masks[measurement.stamp_ns] = {
                pair.left.name: person(measurement.images[j][0]) for j, pair in enumerate(source.rig.pairs)
            }
        estimate = odometry.process(measurement)
        for j, report in (estimate.pairs if estimate is not None else {}).items():
            assert estimate is not None
            mask = masks[estimate.stamp_ns][source.rig.pairs[j].left.name]
            columns, rows = np.rint(report.pixels).astype(int).T
            assert mask[rows, columns].all()
            assert len(columns) > 20


def test_a_mask_over_a_third_of_each_image_costs_little_accuracy(room_walk: Path) -> None:
    """With both pairs and each alone, together: the error of one run is some tenths of a millimetre, by chance."""

    def standing(camera: str, image: Image) -> Bool:
        mask = np.ones(image.shape, dtype=bool)
        mask[:, image.shape[1] // 3 : 2 * image.shape[1] // 3] = False
        return mask

    truth_file = open_source(room_walk).truth
    assert truth_file is not None
    ates_m: dict[bool, list[float]] = {False: [], True: []}
    for is_masked, pairs in itertools.product(ates_m, ((0, 1), (0,), (1,))):
        estimates = estimates_of(room_walk, standing if is_masked else None, 80, pairs=pairs)
        posed = [e for e in estimates if e.nav_T_body is not None]
        poses: Float = np.array([e.nav_T_body for e in posed])
        estimated = Trajectory(np.array([e.stamp_ns for e in posed], dtype=np.int64), poses)
        ates_m[is_masked].append(evaluate(estimated, load_trajectory(truth_file)).ate_position_m.rmse)
    assert sum(ates_m[True]) < 1.3 * sum(ates_m[False])
    assert max(ates_m[True]) < 0.003


def test_none_is_no_mask(room_walk: Path) -> None:
    without, with_none = (
        [e.nav_T_body for e in estimates_of(room_walk, mask, 20)] for mask in (None, lambda camera, image: None)
    )
    for one, other in zip(without, with_none, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_mask_of_another_size_names_the_camera(room_walk: Path) -> None:
    def wrong(camera: str, image: Image) -> AnyArray:
        return np.ones((10, 10), dtype=np.uint8)

    with pytest.raises(RigError, match=r"camera cam\d: the mask of an image has shape \(10, 10\); it must be"):
        list(estimates_of(room_walk, wrong, 2))


def masked_euroc(path: Path, frames: int = 6) -> Path:
    """A small recording of which cam0 has masks of all images but the last, which is damaged, and cam3 of the first."""
    write_euroc(path, frames=frames)
    for camera, masked in (("cam0", frames), ("cam3", 1)):
        folder = path / "mav0" / camera
        for number, image in enumerate(sorted((folder / "data").glob("*.png"))[:masked]):
            mask = (noise_image(1000 + number) > 100).astype(np.uint8) * 255
            write_image(folder / "masks" / image.name, mask)
    (path / "mav0/cam0/masks" / image_names(path)[-1]).write_bytes(b"no image")
    return path


def image_names(path: Path) -> list[str]:
    return sorted(image.name for image in (path / "mav0/cam0/data").glob("*.png"))


def masks_of(source: Source) -> list[dict[int, tuple[Image | None, ...]]]:
    return [dict(each.masks) for each in source if isinstance(each, FrameSet)]


def test_masks_beside_images_come_with_their_framesets(tmp_path: Path) -> None:
    source = open_source(masked_euroc(tmp_path))
    found = masks_of(source)
    for number, masks in enumerate(found[:-1]):
        assert masks[0][1] is None
        np.testing.assert_array_equal(masks[0][0], (noise_image(1000 + number) > 100) * 255)
    assert found[-1][0] == (None, None)
    assert found[0][1][0] is None
    assert found[0][1][1] is not None
    assert source.faults.counts == {"mask_missing": 6}


@pytest.mark.parametrize("image_format", ["raw", "png"])
def test_masks_go_through_sessions_and_back(tmp_path: Path, image_format: ImageFormat) -> None:
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    source = open_source(masked_euroc(tmp_path / "walk"))

    def converted(read: Source, writer: SessionWriter | EurocWriter) -> Source:
        with writer:
            for measurement in read:
                writer.add(measurement)
        return open_source(writer.path)

    session = converted(source, SessionWriter(tmp_path / "walk.mcap", source.rig, image_format))
    again = converted(session, EurocWriter(tmp_path / "again", session.rig))
    assert [pair.name for pair in session.rig.pairs] == ["pair0", "pair1"]  # and none of masks
    for one, other, third in zip(masks_of(source), masks_of(session), masks_of(again), strict=True):
        for j, masks in one.items():
            for a, b, c in zip(masks, other[j], third[j], strict=True):
                assert (a is None) == (b is None) == (c is None)
                if a is not None:
                    np.testing.assert_array_equal(a, b)
                    np.testing.assert_array_equal(a, c)


def test_masks_of_a_named_topic(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    source = open_source(masked_euroc(tmp_path / "walk"))
    with SessionWriter(tmp_path / "walk.mcap", source.rig) as writer:
        for measurement in source:
            writer.add(measurement)
    exchanged = open_source(tmp_path / "walk.mcap", topics={"cam1/mask": "/pair0/left/mask"})
    masks = masks_of(exchanged)[0][0]
    np.testing.assert_array_equal(masks[1], masks[0])


def test_masks_from_files_act_as_those_of_a_function(room_walk: Path, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").symlink_to(room_walk / "rig.yaml")
    for sensor in (room_walk / "mav0").iterdir():
        if sensor.is_dir():
            (tmp_path / "mav0" / sensor.name).mkdir(parents=True)
            for entry in sensor.iterdir():
                (tmp_path / "mav0" / sensor.name / entry.name).symlink_to(entry)
    for image in (f for n in range(4) for f in sorted((room_walk / "mav0" / f"cam{n}" / "data").iterdir())[:12]):
        mask = person(np.asarray(cv2.imread(str(image), cv2.IMREAD_GRAYSCALE), dtype=np.uint8))
        write_image(tmp_path / "mav0" / image.parent.parent.name / "masks" / image.name, mask.astype(np.uint8))
    by_function = list(estimates_of(room_walk, lambda camera, image: person(image), 10))
    from_files = list(estimates_of(tmp_path, None, 10))
    for one, other in zip(by_function, from_files, strict=True):
        np.testing.assert_array_equal(one.nav_T_body, other.nav_T_body)
        for j, report in one.pairs.items():
            np.testing.assert_array_equal(report.pixels, other.pairs[j].pixels)


def test_mask_files_of_another_size_name_camera_and_remedy(tmp_path: Path) -> None:
    rig = small_rig(1)
    camera = rig.pairs[0].left
    small = np.ones((10, 10), dtype=np.uint8)
    image = noise_image(1)
    frameset = FrameSet(0, {0: (image, image)}, {0: (None, small)})
    with pytest.raises(
        RigError, match=r"camera cam1: the mask .* \(10, 10\); it must be \(48, 64\), the size .*: make"
    ):
        checked(frameset, rig)
    with pytest.raises(RigError, match="has 1 masks; give one for each"):
        checked(FrameSet(0, {0: (image, image)}, {0: (None,)}), rig)
    write_image(tmp_path / "mask.png", small)
    with pytest.raises(RigError, match=r"camera cam0: mask .* is 10x10 pixels large; give an image of 64x48 pixels"):
        UsablePixels(replace(camera, mask=tmp_path / "mask.png"), 5)


def test_masks_that_are_no_mapping_are_refused() -> None:
    masks: Any = [None]
    measurement: Measurement = FrameSet(0, {}, masks)
    with pytest.raises(MeasurementError, match="masks is a list"):
        Odometry(small_rig(1)).process(measurement)


def test_pixels_of_a_fisheye_that_have_no_ray_hold_no_points() -> None:
    fisheye = Camera("cam0", "equidistant", (320, 320), np.array([96.0, 96.0, 160.0, 160.0]), np.zeros(4), np.eye(4))
    x, y = np.meshgrid(np.arange(320), np.arange(320))
    angle_deg = np.rad2deg(np.hypot(x - 160.0, y - 160.0) / 96.0)  # up to 135 degrees
    usable = UsablePixels(fisheye, 11).always
    assert not usable[angle_deg > 77.0].any()  # a patch reaches 6 pixels beyond its centre, 3.6 degrees
    assert usable[angle_deg < 74.0].all()
    assert UsablePixels(small_rig(1).pairs[0].left, 11).always.all()

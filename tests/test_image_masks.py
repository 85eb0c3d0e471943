"""A mask for each image, as somebody's segmentation makes it."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from recordings import half_size_rig
from rendered import rendered_once

from graphvio import FrameSet, Odometry, RigError, Trajectory, load_trajectory, open_source
from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.evaluation import evaluate
from graphvio.frontend.images import ImageMask
from graphvio.measurements.estimate import Estimate
from graphvio.simulation import Simulator, build_scene, write_recording

DURATION_S = 5.0


@pytest.fixture(scope="module")
def walk() -> Path:
    def write(folder: Path) -> None:
        write_recording(Simulator(build_scene("room", DURATION_S), half_size_rig(), 2), folder)

    return rendered_once("room-masks", write, "320x240", DURATION_S)


def estimates_of(walk: Path, image_mask: ImageMask | None, frames: int | None = None) -> Iterator[Estimate]:
    source = open_source(walk)
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


@pytest.mark.heavy
def test_masked_pixels_hold_no_tracks(walk: Path) -> None:
    masks: dict[int, dict[str, Bool]] = {}
    source = open_source(walk)
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


@pytest.mark.heavy
def test_a_mask_over_a_third_of_each_image_costs_little_accuracy(walk: Path) -> None:
    def standing(camera: str, image: Image) -> Bool:
        mask = np.ones(image.shape, dtype=bool)
        mask[:, image.shape[1] // 3 : 2 * image.shape[1] // 3] = False
        return mask

    truth_file = open_source(walk).truth
    assert truth_file is not None
    ates_m = []
    for image_mask in (None, standing):
        posed = [e for e in estimates_of(walk, image_mask) if e.nav_T_body is not None]
        poses: Float = np.array([e.nav_T_body for e in posed])
        estimated = Trajectory(np.array([e.stamp_ns for e in posed], dtype=np.int64), poses)
        ates_m.append(evaluate(estimated, load_trajectory(truth_file)).ate_position_m.rmse)
    assert ates_m[1] < 1.3 * ates_m[0]
    assert ates_m[1] < 0.003


def test_none_is_no_mask(walk: Path) -> None:
    without, with_none = (
        [e.nav_T_body for e in estimates_of(walk, mask, 20)] for mask in (None, lambda camera, image: None)
    )
    for one, other in zip(without, with_none, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_mask_of_another_size_names_the_camera(walk: Path) -> None:
    def wrong(camera: str, image: Image) -> AnyArray:
        return np.ones((10, 10), dtype=np.uint8)

    with pytest.raises(RigError, match=r"camera cam\d: the mask of an image has shape \(10, 10\); it must be"):
        list(estimates_of(walk, wrong, 2))

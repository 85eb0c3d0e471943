"""Selection of places, and the motion from one to the next by the chain of keyframes."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from graphvio.arrays import Float, Image
from graphvio.config.stages import OptimizationConfig
from graphvio.errors import MapError, SourceError
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.mapping.intake import Intake
from graphvio.mapping.places import PlaceChooser, motion_between, spread_keyframes
from graphvio.measurements.estimate import Status
from graphvio.rig import Rig
from graphvio.simulation import default_rig
from graphvio.slam.keyframe import CorrectionResult, Keyframe, Landmarks

SIGMAS = np.repeat([2e-3, 1e-2], 3)
STEP = se3_exp(np.array([0.0, 0.0, 0.05, 0.15, 0.0, 0.0]))  # 15 cm, and 2.9 degrees to the left


def some_images() -> dict[int, tuple[Image, Image]]:
    image = np.zeros((16, 16), dtype=np.uint8)
    return {0: (image, image)}


def chain(count: int, first_epoch: int = 0, begin: int = 0) -> list[Keyframe]:
    """Keyframes of an epoch, a step apart."""
    made, pose, covariance = [], np.eye(4), np.diag(SIGMAS**2)
    for k in range(begin, begin + count):
        is_first = k == begin
        made.append(
            Keyframe(
                k, first_epoch, 100 * k, Status.TRACKING, pose, covariance, None if is_first else k - 1,
                None if is_first else STEP, None if is_first else np.diag(SIGMAS**2), Landmarks.none(), some_images(),
            )
        )  # fmt: skip
        pose = pose @ STEP
        covariance = covariance + np.diag(SIGMAS**2)
    return made


class Listed:
    """A front-end that yields given keyframes, and then raises an error, if any."""

    def __init__(self, keyframes: Sequence[Keyframe], failure: Exception | None = None) -> None:
        self._keyframes = keyframes
        self._failure = failure
        self.is_read = threading.Event()

    @property
    def rig(self) -> Rig:
        return default_rig()

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        yield from self._keyframes
        self.is_read.set()
        if self._failure is not None:
            raise self._failure

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        raise AssertionError("nothing was recognised")


def test_places_are_as_far_apart_as_configured() -> None:
    chooser = PlaceChooser(0.4, 90.0)
    places = [each.keyframe.id for key in chain(13) if (each := chooser.add(key)[0]) is not None]
    assert places == [0, 3, 6, 9, 12]
    turning = PlaceChooser(10.0, 5.5)
    assert [k.id for k in chain(7) if turning.add(k)[0] is not None] == [0, 2, 4, 6]
    dense = PlaceChooser(0.4, 90.0)
    assert [k.id for k in chain(5) if dense.add(k, share=0.25)[0] is not None] == [0, 1, 2, 3, 4]


def test_motion_and_covariance_follow_the_chain() -> None:
    """A place's motion scatters as its covariance says."""
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(400):
        chooser, last = PlaceChooser(0.4, 90.0), None
        for key in chain(4):
            noisy = key
            if key.previous_T_body is not None:
                noisy = replace(key, previous_T_body=key.previous_T_body @ se3_exp(SIGMAS * rng.standard_normal(6)))
            last = chooser.add(noisy)[0]
        assert last is not None
        assert last.previous_T_body is not None
        assert last.covariance is not None
        errors.append(se3_log(se3_inverse(STEP @ STEP @ STEP) @ last.previous_T_body))
        covariance = last.covariance
    white = np.linalg.solve(np.linalg.cholesky(covariance), np.array(errors).T)
    np.testing.assert_allclose(white @ white.T / len(errors), np.eye(6), atol=0.25)


def test_epoch_begins_a_fragment() -> None:
    chooser = PlaceChooser(0.4, 90.0)
    for key in chain(5):
        chooser.add(key)
    place, _ = chooser.add(chain(1, first_epoch=1, begin=5)[0])
    assert place is not None
    assert place.previous_T_body is None


def test_lost_keyframes_are_bridged_by_poses_in_the_epochs_frame() -> None:
    keys = chain(6)
    motion, covariance = motion_between(keys[1], keys[4])
    np.testing.assert_allclose(motion, STEP @ STEP @ STEP, atol=1e-12)
    assert np.linalg.eigvalsh(covariance - keys[4].covariance)[0] > 0.0
    reported, reported_covariance = motion_between(keys[1], keys[2])
    np.testing.assert_array_equal(reported, STEP)
    np.testing.assert_array_equal(reported_covariance, np.diag(SIGMAS**2))


def test_without_room_the_next_keyframe_is_the_place() -> None:
    chooser = PlaceChooser(0.4, 90.0)
    keys = chain(6)
    for key in keys[:3]:
        chooser.add(key)
    assert chooser.add(keys[3], has_room=False) == (None, True)
    place, is_one = chooser.add(keys[4])
    assert is_one
    assert place is not None
    assert place.previous_T_body is not None
    np.testing.assert_allclose(place.previous_T_body, np.linalg.matrix_power(STEP, 4), atol=1e-12)


def test_places_beyond_the_queue_are_skipped_and_counted() -> None:
    """Without a consumer eight places wait, and all keyframes are still read."""
    front_end = Listed(chain(60))
    intake = Intake(front_end, OptimizationConfig(), lambda: 1.0)
    intake.start()
    assert front_end.is_read.wait(10.0)
    assert intake.waiting == 8
    assert intake.skipped == 60 - 24  # places are three keyframes apart: the ninth would be keyframe 24
    assert len(intake.keyframes) == 60
    taken = [intake.next() for _ in range(9)]
    assert [each.keyframe.id for each in taken if each is not None] == [0, 3, 6, 9, 12, 15, 18, 21]
    assert taken[-1] is None


def test_failures_of_the_front_end_are_raised_after_the_last_place() -> None:
    intake = Intake(Listed(chain(1), SourceError("the wire is cut")), OptimizationConfig(), lambda: 1.0)
    intake.start()
    assert intake.next() is not None
    with pytest.raises(SourceError, match="the wire is cut"):
        intake.next()


def test_keyframes_without_images_raise() -> None:
    intake = Intake(Listed([replace(key, images={}) for key in chain(3)]), OptimizationConfig(), lambda: 1.0)
    intake.start()
    with pytest.raises(MapError, match="have no images"):
        intake.next()


def test_lost_keyframes_are_counted() -> None:
    intake = Intake(Listed([*chain(3), *chain(20)[10:]]), OptimizationConfig(), lambda: 1.0)
    intake.start()
    while intake.next() is not None:
        pass
    assert intake.lost == 7


def test_keyframes_move_with_their_place() -> None:
    """The second place is moved by 6 cm: keyframes before it in proportion to time, those after it by all."""
    chooser, keys, located = PlaceChooser(0.4, 90.0), chain(6), []
    for key in keys:
        chooser.add(key)
        at = chooser.newest()
        assert at is not None
        located.append(at)
    three = np.linalg.matrix_power(STEP, 3)
    poses = [np.eye(4), three @ se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.06]))]
    found = spread_keyframes(located, poses, [np.eye(4), three], {0})
    assert found.stamps_ns.tolist() == [key.stamp_ns for key in keys]
    np.testing.assert_allclose(found.positions[:, 2], [0.0, 0.02, 0.04, 0.06, 0.06, 0.06], atol=1e-12)
    not_joined = spread_keyframes(located, [None, poses[1]], [np.eye(4), three], {0, 1})
    assert not_joined.stamps_ns.tolist() == [300, 400, 500]

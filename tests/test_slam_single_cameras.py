"""The SLAM system behind the odometry of single cameras: motions and corrections are consistent."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from calibration_walks import recorded
from monte_carlo import band
from test_optimize import SECONDS, to_and_fro

from graphvio import Config, Odometry, open_source
from graphvio.arrays import Float
from graphvio.geometry import se3_inverse, se3_log
from graphvio.mapping.mapper import Mapper
from graphvio.rig import Rig
from graphvio.slam import FrontEnd
from graphvio.slam.keyframe import CorrectionResult, Keyframe
from graphvio.trajectory_files import load_trajectory

pytest.importorskip("pycolmap", reason="maps need the extra maps")

CONFIG = Config.from_yaml(
    "{optimization: {loop_interval_s: 3.0, place_distance_m: 0.2, features: 500}, "
    "keyframes: {images: true, descriptors: none}}"
)
_POLL_S = 0.002
_MAX_ERROR_SHARES = {"cam0": 0.7, "cam0,cam2": 0.25}
"""Cameras -> error in the map by that of the odometry; with six seeds of the noise it was 0.24-0.57 and 0.07-0.17."""


@dataclass(eq=False)
class Paced:
    """A front-end whose keyframes come as fast as places are worked on."""

    front_end: FrontEnd
    made: list[Keyframe]
    has_room: Callable[[], bool] = lambda: True
    corrections: list[tuple[int, Float, Float, CorrectionResult]] = field(default_factory=list)

    @property
    def rig(self) -> Rig:
        return self.front_end.rig

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        for each in self.made[from_id:]:
            while not self.has_room():
                time.sleep(_POLL_S)
            yield each

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        result = self.front_end.correct(keyframe_id, map_T_body, covariance)
        self.corrections.append((keyframe_id, map_T_body, covariance, result))
        return result


@dataclass(frozen=True, eq=False)
class Walked:
    """A walk: keyframes, their true poses (N, 4, 4), poses in the map, and the odometry's correction at the end."""

    max_error_share: float
    front_end: Paced
    truth: Float
    in_map: Float
    closures_used: int


@pytest.fixture(scope="module", params=list(_MAX_ERROR_SHARES))
def walked(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Walked:
    path = recorded(tmp_path_factory.mktemp("slam") / "walk", SECONDS, to_and_fro)
    rig = open_source(path).rig.with_only(request.param.split(",")).without_pairs()
    source, odometry = open_source(path, rig), Odometry(rig, CONFIG)
    paced = Paced(FrontEnd(odometry), [])
    paced.front_end.on_keyframe(paced.made.append)
    for measurement in source:
        odometry.process(measurement)
    odometry.finish()
    with Mapper(paced, CONFIG) as mapper:
        paced.has_room = lambda: mapper.summary()["places_waiting"] in (0, 1)
        mapper.run()
    assert source.truth is not None
    stamps = np.array([each.stamp_ns for each in paced.made])
    truth, is_known = load_trajectory(source.truth).at(stamps, 0.1)
    assert is_known.all()
    assert len(mapper.trajectory) == len(stamps)
    used = sum(is_used for _, is_used in mapper.closures)
    return Walked(_MAX_ERROR_SHARES[request.param], paced, truth.nav_T_body, mapper.trajectory.nav_T_body, used)


def squared(measured: Float, true: Float, covariance: Float) -> float:
    error = se3_log(np.ascontiguousarray(se3_inverse(measured) @ true))
    return float(error @ np.linalg.solve(covariance, error))


def off_m(poses: Float, truth: Float) -> Float:
    """Return errors (N,) of positions in body at the first."""
    return np.asarray(np.linalg.norm((se3_inverse(poses[0]) @ poses - se3_inverse(truth[0]) @ truth)[:, :3, 3], axis=1))


def test_relative_motions_of_keyframes_are_consistent(walked: Walked) -> None:
    squares = []
    for each in walked.front_end.made:
        if each.previous_id is not None:
            assert each.previous_T_body is not None
            assert each.relative_covariance is not None
            true = se3_inverse(walked.truth[each.previous_id]) @ walked.truth[each.id]
            squares.append(squared(each.previous_T_body, true, each.relative_covariance))
    assert len(squares) > 10
    assert np.mean(squares) < 9.0


def test_corrections_are_accepted_and_consistent(walked: Walked) -> None:
    assert len(walked.front_end.corrections) >= 5
    odom_T_world = walked.front_end.made[0].odom_T_body @ se3_inverse(walked.truth[0])
    squares = []
    for number, map_T_body, covariance, result in walked.front_end.corrections:
        assert result.accepted
        squares.append(squared(map_T_body, odom_T_world @ walked.truth[number], covariance))
    assert np.mean(squares) < band(1)[1]  # the corrections of one walk share most of their error: one sample
    assert walked.front_end.front_end.map_T_odom is not None


def test_map_is_more_accurate_than_odometry(walked: Walked) -> None:
    assert walked.closures_used >= 5
    online = np.array([each.odom_T_body for each in walked.front_end.made])
    in_map_m, online_m = (np.sqrt((off_m(each, walked.truth) ** 2).mean()) for each in (walked.in_map, online))
    assert in_map_m < walked.max_error_share * online_m


def test_landmarks_are_consistent_with_their_pixels(walked: Walked) -> None:
    """Points in body, projected into their camera, are where the corner was tracked."""
    errors = []
    for each in walked.front_end.made:
        marks = each.landmarks
        for j, single in enumerate(walked.front_end.rig.singles):
            rows, cam_T_body = marks.pair == j, single.left.cam_T_body
            pixels, _ = single.left.project(marks.points_body[rows] @ cam_T_body[:3, :3].T + cam_T_body[:3, 3])
            errors += np.linalg.norm(pixels - marks.left_px[rows], axis=1).tolist()
    assert len(errors) > 500
    assert np.median(errors) < 0.5

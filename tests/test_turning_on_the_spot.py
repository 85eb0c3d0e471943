"""A single camera that turns on the spot: tracks are looked for where the gyro says, and no scale is made up."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from rendered import rendered_once

from graphvio import Odometry, open_source
from graphvio.arrays import Float
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import EventKind
from graphvio.measurements.motion import CameraTracks, VisualResult
from graphvio.simulation import build_scene, default_rig, write_recording
from graphvio.simulation.motion import Motion
from graphvio.simulation.simulator import Simulator

DURATION_S, STILL_S = 5.0, 1.0
RATE = 1.2  # rad/s: 24 pixels from image to image
MAX_PARALLAX = 0.02  # rad from image to image: the camera is 0.18 m from body's origin, and nothing is nearer than 1 m


class Turned(NamedTuple):
    statuses: list[Status]
    kinds: list[str]
    camera_tracks: list[CameraTracks]
    world_R_cam: Float  # (N, 3, 3), true


def course(times: Float) -> Float:
    """Turn at one place, but for a sway of millimetres."""
    t = np.clip(times - STILL_S, 0.0, None)
    r = np.minimum(t / STILL_S, 1.0)
    t = np.where(r < 1.0, STILL_S * r**4 * (2.5 - 3.0 * r + r * r), t - 0.5 * STILL_S)  # up to speed smoothly
    sway = 0.003 * np.sin(np.outer(t, [2.1, 2.9, 3.7]) + np.array([0.0, 1.0, 0.0]))
    tilt = 0.01 * np.sin(np.outer(t, [5.1, 6.3]))
    return np.column_stack([np.array([-1.6, -1.9, 1.45]) + sway, RATE * t, tilt])


@pytest.fixture(scope="module")
def turned() -> Turned:
    scene = replace(build_scene("room"), motion=Motion(course, DURATION_S))
    rig = default_rig().with_only(["cam0"])
    simulator = Simulator(scene, rig)
    path = simulator.world_T_body.tobytes()
    source = open_source(rendered_once("on-the-spot", lambda folder: write_recording(simulator, folder), path))
    odometry, camera_tracks = Odometry(source.rig), list[CameraTracks]()
    process = odometry._frontend.process

    def listened(*args: object) -> VisualResult:
        visual = process(*args)  # type: ignore[arg-type]
        camera_tracks.append(visual.camera_tracks[0])
        return visual

    odometry._frontend.process = listened  # type: ignore[method-assign,assignment]
    estimates: list[Estimate | None] = [odometry.process(measurement) for measurement in source]
    world_R_cam = simulator.world_T_body[:, :3, :3] @ rig.cameras[0].body_T_cam[:3, :3]
    statuses = [estimate.status for estimate in estimates if estimate is not None]
    return Turned(statuses, [event.kind for event in odometry.take_events()], camera_tracks, world_R_cam)


def test_tracks_of_a_camera_that_turns_end_where_their_points_leave_the_image(turned: Turned) -> None:
    """Next to the edge of the image, something similar would be found instead, again in each image."""
    n_tracks, n_wrong = 0, 0
    for k in range(len(turned.camera_tracks) - 1):
        before, now = turned.camera_tracks[k : k + 2]
        _, rows_before, rows_now = np.intersect1d(before.ids, now.ids, return_indices=True)
        directions = [
            np.column_stack([each.rays[rows], np.ones(len(rows))]) @ turned.world_R_cam[at].T
            for each, rows, at in ((before, rows_before, k), (now, rows_now, k + 1))
        ]
        one, other = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in directions)
        n_tracks += len(one)
        n_wrong += int((np.linalg.norm(one - other, axis=1) > MAX_PARALLAX).sum())
    assert n_tracks > 10_000
    assert n_wrong < 0.003 * n_tracks


def test_camera_that_turns_on_the_spot_has_no_pose(turned: Turned) -> None:
    assert set(turned.statuses) == {Status.INITIALISING}
    assert EventKind.SCALE_KNOWN not in turned.kinds

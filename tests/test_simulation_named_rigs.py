"""Rigs that the simulator knows by name: what their cameras see."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from graphvio.rig import overlap
from graphvio.simulation import Simulator, build_scene
from graphvio.simulation.named_rigs import NAMED_RIGS, headset, phone, surround


@pytest.mark.parametrize("name", ["headset", "surround", "phone"])
def test_every_camera_of_a_named_rig_sees_the_room(name: str) -> None:
    rig = NAMED_RIGS[name]()
    simulator = Simulator(build_scene("room", 4.0), rig)
    surfaces = simulator.surfaces(40)
    for number, camera in enumerate(rig.cameras):
        view = simulator.view(40, number, surfaces)
        assert np.isfinite(view.depth).all()  # no part of an image is without a ray, or looks past the walls
        image = simulator.image(40, number, surfaces=surfaces)
        assert 20.0 < image.mean() < 235.0
        corners = cv2.goodFeaturesToTrack(image, 200, 0.02, 12)
        assert corners is not None
        assert len(corners) > 60, camera.name


def test_the_headset_has_fisheyes_that_reach_as_far_as_lenses_may() -> None:
    rig = headset()
    for camera in rig.cameras:
        width, height = camera.size_px
        rays, valid = camera.unproject(np.array([[0.0, 0.0], [0.0, height / 2], [width - 1.0, height - 1.0]]))
        assert valid.all()
        off_axis_deg = np.rad2deg(np.arctan(np.hypot(rays[:, 0], rays[:, 1])))
        assert 100.0 < 2.0 * off_axis_deg[1] < 160.0
        assert 75.0 < off_axis_deg[0] < 80.0
    assert [pair.name for pair in rig.pairs] == ["front"]
    assert overlap(rig.pairs[0].left, rig.pairs[0].right) > 0.6


def test_surround_sees_all_around_without_a_pair() -> None:
    rig = surround()
    assert not rig.pairs
    assert len(rig.singles) == 6
    yaws = np.deg2rad(np.arange(0.0, 360.0, 5.0))
    points = 4.0 * np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(len(yaws))])
    seen = np.zeros(len(points), dtype=int)
    for camera in rig.cameras:
        seen += camera.project(points @ camera.cam_T_body[:3, :3].T + camera.cam_T_body[:3, 3])[1]
    assert seen.min() >= 1


def test_the_phone_has_a_rolling_shutter_of_20_ms() -> None:
    (camera,) = phone().cameras
    assert camera.readout_ns == pytest.approx(20e6, rel=0.01)
    simulator = Simulator(build_scene("room", 4.0), phone())
    still = Simulator(simulator.scene, phone().with_cameras(lambda camera: replace(camera, line_time_us=0.0)))
    rolled, as_one = simulator.view(60, 0).depth, still.view(60, 0).depth
    np.testing.assert_allclose(rolled[0], as_one[0], rtol=1e-9)
    assert np.abs(rolled[-1] - as_one[-1]).max() > 0.003

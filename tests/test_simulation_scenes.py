from functools import cache

import cv2
import numpy as np
import pytest
from recordings import half_size_rig

from graphvio.arrays import Image
from graphvio.errors import SourceError
from graphvio.simulation import SCENE_NAMES, Simulator, build_scene, make_simulator
from graphvio.simulation.named_rigs import NAMED_RIGS

STRENGTH = 1e-3  # smallest eigenvalue of a corner that stands out from the noise


@pytest.fixture(scope="module")
def corridor() -> Simulator:
    return make_simulator("corridor", duration_s=42.0)


@pytest.fixture(scope="module")
def small_corridor() -> Simulator:
    """Of images with a quarter of the pixels, for shares of them."""
    return make_simulator("corridor", duration_s=42.0, rig=half_size_rig())


def corners(image: Image) -> int:
    """Number of corners that stand out, at least 10 pixels apart."""
    strength = cv2.cornerMinEigenVal(image, 5, ksize=3)
    peaks = strength == cv2.dilate(strength, np.ones((21, 21)))
    return int(np.count_nonzero(peaks & (strength > STRENGTH)))


def at(simulator: Simulator, time_s: float) -> int:
    return round(time_s * simulator.rates_hz[0])


def test_build_scene_bad_arguments_are_refused() -> None:
    with pytest.raises(SourceError, match="room"):
        build_scene("kitchen")
    for duration in (0.0, -1.0, float("nan")):
        with pytest.raises(SourceError, match="duration"):
            build_scene("room", duration)
    with pytest.raises(SourceError, match="rate"):
        make_simulator("room", rate_hz=0.0)
    with pytest.raises(SourceError, match="seed"):
        make_simulator("room", seed=-1)


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_scene_every_camera_sees_texture_without_holes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = make_simulator(name)
    seen = cache(simulator.view)
    monkeypatch.setattr(simulator, "view", seen)  # of which the image is made
    last = len(simulator.stamps_ns) - 1
    for index in (0, last // 5, last):
        for camera in range(len(simulator.rig.cameras)):
            view = seen(index, camera, None)
            assert np.isfinite(view.depth).all()  # the world is closed
            assert view.depth.min() > 0.15  # nobody walks through a wall
            image = simulator.image(index, camera)
            assert 25 < image.mean() < 170
            assert corners(image) > 80


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_scene_cameras_keep_distance(name: str) -> None:
    scene = build_scene(name)
    world_T_body = scene.motion.at(np.arange(0.0, scene.motion.duration_s, 0.05)).world_T_body
    origin, u, v = np.array([(r.origin, r.edge_u, r.edge_v) for r in scene.world.rectangles]).swapaxes(0, 1)
    normal = np.cross(u, v)
    for camera in NAMED_RIGS[scene.rig]().cameras:
        centres = (world_T_body @ camera.body_T_cam)[:, :3, 3]
        side = centres @ normal.T - np.sum(origin * normal, axis=1)
        step, surface = np.nonzero(side[:-1] * side[1:] <= 0.0)  # where a plane is crossed
        place = centres[step] - origin[surface]
        within = [np.sum(place * edge[surface], axis=1) / np.sum(edge[surface] ** 2, axis=1) for edge in (u, v)]
        assert not np.any((within[0] >= 0.0) & (within[0] <= 1.0) & (within[1] >= 0.0) & (within[1] <= 1.0))


def test_corridor_bend_blinds_both_pairs(corridor: Simulator) -> None:
    start, end = corridor.scene.events["blank"]
    assert end < 40.0
    assert 0.8 <= end - start <= 1.5
    for time_s in np.linspace(start, end, 6):
        assert max(corners(corridor.image(at(corridor, time_s), camera)) for camera in range(4)) < 12
    for time_s in (start - 1.5, end + 1.5):  # a moment before and after, one of them sees again
        assert max(corners(corridor.image(at(corridor, time_s), camera)) for camera in (0, 2)) > 40


def test_corridor_door_fills_front_view(small_corridor: Simulator) -> None:
    start, end = small_corridor.scene.events["door"]
    seen = [small_corridor.view(at(small_corridor, t), 0).is_moving.mean() for t in np.linspace(start, end, 6)]
    assert max(seen) > 0.2
    first, second = (small_corridor.surfaces(at(small_corridor, t)).corners for t in (start + 0.5, start + 0.8))
    assert np.abs(first - second).max() > 0.05


def test_corridor_people_pass_both_pairs(small_corridor: Simulator) -> None:
    start, end = small_corridor.scene.events["people"]
    for camera in (0, 2):
        seen = [
            small_corridor.view(at(small_corridor, t), camera).is_moving.mean()
            for t in np.arange(start + 2, end - 2, 0.5)
        ]
        assert max(seen) > 0.1


def test_corridor_lamps_dim_and_return(corridor: Simulator) -> None:
    start, end = corridor.scene.events["dim"]
    assert end < 42.0
    dark = corridor.image(at(corridor, 0.5 * (start + end)), 0)
    bright = corridor.image(at(corridor, end + 1.0), 0)
    assert dark.mean() < 0.5 * bright.mean()
    assert corners(dark) > 40


def test_shorter_walk_is_beginning_of_whole(corridor: Simulator) -> None:
    cut = make_simulator("corridor", duration_s=6.0)
    assert np.array_equal(cut.world_T_body, corridor.world_T_body[: len(cut.stamps_ns)])
    assert cut.scene.events == corridor.scene.events
    assert np.array_equal(cut.image(119, 0), corridor.image(119, 0))


def test_loop_revisits_first_place_both_ways() -> None:
    scene = build_scene("loop")
    times = np.arange(0.0, scene.motion.duration_s, 0.05)
    states = scene.motion.at(times)
    position, forward = states.world_T_body[:, :3, 3], states.world_T_body[:, :3, 0]
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])
    away = np.linalg.norm(position - position[0], axis=1)
    assert 75.0 < walked[-1] < 90.0
    assert away.max() > 15.0
    at_start = (away < 0.15) & (walked > 1.0)
    turned = times > scene.events["turn"][1]
    again, back = at_start & ~turned, at_start & turned
    assert again.any()
    assert times[again].mean() == pytest.approx(scene.events["again"][0], abs=0.1)
    assert (forward[again] @ forward[0] > 0.95).all()
    assert back.any()
    assert scene.events["back"][0] < times[back].min() < times[back].max() < scene.events["back"][1]
    assert (forward[back] @ forward[0] < -0.95).all()
    assert np.abs(states.angular_velocity).max() < 2.0  # nobody turns on the spot
    assert np.linalg.norm(states.velocity[times > scene.motion.duration_s - 0.5], axis=1).max() < 1e-9


def test_loop_legs_share_textures_and_doors() -> None:
    def leg(x: float, y: float) -> str:
        return "south" if y < 2.0 else "north" if y > 9.0 else "east" if x > 0.0 else "west"

    simulator = make_simulator("loop", rate_hz=0.4)
    doors = [r.origin + 0.5 * r.edge_u for r in simulator.scene.world.rectangles if r.texture == "door"]
    seen = [leg(x, y) for x, y in simulator.world_T_body[:, :2, 3]]
    for name in ("south", "east", "north", "west"):
        assert sum(leg(x, y) == name for x, y, _ in doors) >= 3
        assert seen.count(name) >= 2
    for index in range(len(seen)):
        for camera in (0, 2):
            assert corners(simulator.image(index, camera)) > 200


def test_street_stands_clear_of_the_route_and_facades_are_near() -> None:
    scene = build_scene("street")
    track = scene.motion.at(np.arange(0.0, scene.motion.duration_s, 0.1)).world_T_body[:, :2, 3]
    nearest = dict.fromkeys(("facade0", "facade1", "brick", "car", "leaves"), np.inf)
    for r in scene.world.rectangles:
        if r.texture in nearest:
            edge = r.edge_u[:2]
            along = np.clip((track - r.origin[:2]) @ edge / (edge @ edge), 0.0, 1.0)
            gap = np.linalg.norm(r.origin[:2] + along[:, None] * edge - track, axis=1).min()
            nearest[r.texture] = min(nearest[r.texture], gap)
    assert 9.0 < min(nearest["facade0"], nearest["facade1"], nearest["brick"]) < 12.0
    assert 2.5 < nearest["car"] < 5.0
    assert nearest["leaves"] > 2.5


@pytest.mark.parametrize(
    ("name", "baseline_m", "rate_hz", "pixels"),
    [("street", 0.537, 10.0, (1241, 376)), ("flight", 0.11, 20.0, (752, 480))],
)
def test_outdoor_scene_has_rig_and_rate_of_its_own(
    name: str, baseline_m: float, rate_hz: float, pixels: tuple[int, int]
) -> None:
    simulator = make_simulator(name, duration_s=2.0)
    (pair,) = simulator.rig.pairs
    assert np.linalg.norm(pair.left.body_T_cam[:3, 3] - pair.right.body_T_cam[:3, 3]) == pytest.approx(baseline_m)
    assert pair.left.size_px == pixels
    assert simulator.rates_hz == (rate_hz,)
    assert simulator.imu.rate_hz == 200.0
    other = make_simulator(name, duration_s=2.0, rig=half_size_rig(), rate_hz=5.0)
    assert other.rates_hz == (5.0, 5.0)
    assert np.isfinite(other.view(4, 0).depth).all()


def test_flight_looks_down_from_50_m() -> None:
    simulator = make_simulator("flight", duration_s=2.0)
    depth = simulator.view(0, 0).depth
    assert 60.0 < np.median(depth) < 85.0  # 50 m / sin(45 degrees), apart from houses and trees
    assert depth[-1].max() < depth[0].min()

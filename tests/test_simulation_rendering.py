import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from graphvio.arrays import AnyArray, Float, Image
from graphvio.geometry import se3, se3_inverse
from graphvio.rig import Camera
from graphvio.simulation import Simulator, make_simulator
from graphvio.simulation.default_rig import default_rig, paper_left2_T_left1
from graphvio.simulation.renderer import CameraRays
from graphvio.simulation.surfaces import PreparedWorld
from graphvio.simulation.textures import checkerboard, pack
from graphvio.simulation.world import Exposure, Rectangle, World

SQUARES = 8
BOARD_M = 1.2


@pytest.fixture(scope="module")
def room() -> Simulator:
    return make_simulator("room", duration_s=12.0)


def board_world(world_T_board: Float) -> World:
    """A checkerboard in the plane z = 0 of its frame, seen from -z with x to the right and y down."""
    world = World(ambient=1.0)
    corner = np.array([-0.5 * BOARD_M, -0.5 * BOARD_M, 0.0])
    rotation = world_T_board[:3, :3]
    origin = rotation @ corner + world_T_board[:3, 3]
    world.rectangles.append(Rectangle(origin, BOARD_M * rotation[:, 0], BOARD_M * rotation[:, 1], "board", fit=True))
    return world


@pytest.mark.parametrize("camera", range(4))
@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.2), (0.5, 0.3, 0.0), (-0.6, 0.2, 0.7)])
def test_render_corners_match_projection(camera: int, tilt: tuple[float, float, float]) -> None:
    rays = CameraRays(default_rig().cameras[camera])
    world_T_cam = rays.camera.body_T_cam
    rotation = cv2.Rodrigues(np.array(tilt))[0]
    cam_T_board = se3(np.ascontiguousarray(rotation, dtype=np.float64), np.array([0.1, -0.05, 1.3]))
    atlas = pack({"board": (checkerboard(SQUARES), 1.0)})
    surfaces = PreparedWorld(board_world(world_T_cam @ cam_T_board), atlas).at(0.0)
    radiance = rays.render(surfaces, atlas, world_T_cam).radiance
    # The locator works on gradients: without blur it errs by 0.1 px even on exactly integrated pixels.
    image = cv2.GaussianBlur(radiance * np.float32(200.0), (0, 0), 1.2)
    steps = (np.arange(1, SQUARES) / SQUARES - 0.5) * BOARD_M
    inner = np.array([[x, y, 0.0] for x in steps for y in steps])
    truth, inside = rays.camera.project(inner @ cam_T_board[:3, :3].T + cam_T_board[:3, 3])
    inside &= rays.camera.contains(truth, 12.0)
    assert inside.sum() > 30
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    grey = np.clip(image, 0, 255).astype(np.uint8)
    start = truth[inside].astype(np.float32).reshape(-1, 1, 2) + np.float32(0.7)
    found = cv2.cornerSubPix(grey, start, (5, 5), (-1, -1), stop).reshape(-1, 2)
    errors = np.linalg.norm(found - truth[inside], axis=1)
    assert errors.max() < 0.1


def test_default_rig_matches_paper() -> None:
    rig = default_rig()
    np.testing.assert_allclose(rig.left2_T_left1(), paper_left2_T_left1(), atol=1e-12)
    np.testing.assert_allclose(rig.left2_T_left1()[:3, 3], [0.3345, 0.0667, -0.1138], atol=1e-12)
    assert [camera.name for camera in rig.cameras] == ["cam0", "cam1", "cam2", "cam3"]
    for pair, direction in zip(rig.pairs, (1.0, -1.0), strict=True):
        assert 0.11 < pair.baseline_m < 0.13
        assert pair.left.body_T_cam[:3, 2] @ [direction, 0.0, 0.0] > 0.9  # looks forward or back
        assert pair.left.body_T_cam[:3, 1] @ [0.0, 0.0, -1.0] > 0.9  # the right way up


def tracked(first: Image, second: Image, points: Float, guess: Float) -> tuple[Float, Float]:
    """Points of the second image by optical flow, and how far from the start they flow back."""
    there = guess.astype(np.float32).reshape(-1, 1, 2)
    start = points.astype(np.float32).reshape(-1, 1, 2)
    use_guess = cv2.OPTFLOW_USE_INITIAL_FLOW

    def flow(a: Image, b: Image, p: NDArray[np.float32], q: NDArray[np.float32]) -> tuple[Float, AnyArray]:
        moved, ok, _ = cv2.calcOpticalFlowPyrLK(a, b, p, q.copy(), winSize=(15, 15), maxLevel=1, flags=use_guess)
        return np.asarray(moved, dtype=np.float64), np.asarray(ok).ravel() > 0

    found, ok = flow(first, second, start, there)
    back, ok_back = flow(second, first, found.astype(np.float32), start)
    distance = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    distance[~ok | ~ok_back] = np.inf
    return found.reshape(-1, 2), np.asarray(distance)


def flow_errors(simulator: Simulator, a: tuple[int, int], b: tuple[int, int]) -> Float:
    """Errors in pixels of optical flow between two images (index, camera), where nothing moves."""
    first, second = simulator.image(*a), simulator.image(*b)
    corners = cv2.goodFeaturesToTrack(first, 300, 0.02, 10)
    assert corners is not None
    points = np.asarray(corners.reshape(-1, 2), dtype=np.float64)
    points = points[simulator.rig.cameras[a[1]].contains(points, 8.0)]
    view = simulator.view(*a)
    column, row = np.round(points).astype(int).T
    points, static = points, ~view.is_moving[row, column]
    camera_a, camera_b = simulator.rig.cameras[a[1]], simulator.rig.cameras[b[1]]
    rays, _ = camera_a.unproject(points)
    spread = [view.depth[row + dy, column + dx] for dx in (-6, 0, 6) for dy in (-6, 0, 6)]
    smooth = np.ptp(spread, axis=0) < 0.1 * view.depth[row, column]  # not at the edge of an object
    in_a = np.column_stack([rays, np.ones(len(rays))]) * view.depth[row, column][:, None]
    world_T_a = simulator.world_T_body[a[0]] @ camera_a.body_T_cam
    b_T_a = se3_inverse(simulator.world_T_body[b[0]] @ camera_b.body_T_cam) @ world_T_a
    truth, inside = camera_b.project(in_a @ b_T_a[:3, :3].T + b_T_a[:3, 3])
    found, returned = tracked(first, second, points, truth)
    use = inside & static & smooth & (returned < 0.3)
    assert use.sum() > 60
    return np.asarray(np.linalg.norm(found[use] - truth[use], axis=1))


@pytest.mark.parametrize("left", [0, 2])
def test_stereo_flow_matches_depth(room: Simulator, left: int) -> None:
    errors = flow_errors(room, (120, left), (120, left + 1))
    assert np.median(errors) < 0.15


@pytest.mark.parametrize("camera", [0, 3])
def test_temporal_flow_matches_motion(room: Simulator, camera: int) -> None:
    errors = flow_errors(room, (120, camera), (122, camera))
    assert np.median(errors) < 0.15


def test_image_depends_on_seed_only(room: Simulator) -> None:
    again, other = make_simulator("room", duration_s=12.0), make_simulator("room", duration_s=12.0, seed=1)
    assert np.array_equal(room.image(100, 1), again.image(100, 1))
    assert not np.array_equal(room.image(100, 1), other.image(100, 1))
    assert np.array_equal(room.image(100, 1, noisy=False), other.image(100, 1, noisy=False))


def test_image_noise_grows_with_light(room: Simulator) -> None:
    clean = room.image(100, 0, noisy=False).astype(float)
    difference = room.image(100, 0).astype(float) - clean
    dark, bright = (clean > 10) & (clean < 40), (clean > 110) & (clean < 180)
    assert 0.5 < difference[dark].std() < difference[bright].std() < 3.0


def test_film_gain_raises_noise() -> None:
    room = make_simulator("room", duration_s=1.0)
    radiance = np.full((480, 640), 0.4, dtype=np.float32)
    film = room.films[0]
    noise = np.random.default_rng(0)
    full = film.expose(radiance, Exposure(1.0, 1.0), noise).astype(float)
    dim = film.expose(radiance, Exposure(0.2, 5.0), noise).astype(float)
    middle = np.s_[220:260, 300:340]
    assert full[middle].mean() == pytest.approx(dim[middle].mean(), rel=0.01)
    assert dim[middle].std() > 1.5 * full[middle].std()
    assert full[:20, :20].mean() < 0.8 * full[middle].mean()  # vignetting


def test_frameset_holds_all_pairs(room: Simulator) -> None:
    frameset = room.frameset(7)
    assert frameset.stamp_ns == room.stamps_ns[7]
    assert sorted(frameset.images) == [0, 1]
    assert all(image.shape == (480, 640) for pair in frameset.images.values() for image in pair)


def test_pixels_without_a_ray_are_black(room: Simulator) -> None:
    fisheye = Camera("cam0", "equidistant", (160, 160), np.array([48.0, 48.0, 80.0, 80.0]), np.zeros(4), np.eye(4))
    x, y = np.meshgrid(np.arange(160), np.arange(160))
    is_beyond = np.hypot(x - 80.0, y - 80.0) / 48.0 > np.deg2rad(80.0)
    view = CameraRays(fisheye).render(room.surfaces(0), room._prepared.atlas, room.world_T_body[0])
    assert (view.radiance[is_beyond] == 0.0).all()
    assert np.isinf(view.depth[is_beyond]).all()
    assert (view.radiance[~is_beyond] > 0.0).mean() > 0.95

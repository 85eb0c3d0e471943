"""Tracks of single cameras in others that see the same: places against the renderer's depth, warped patches, scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from recordings import half_size

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.frontend.singles import SinglesFrontend
from graphvio.frontend.tracking.overlaps import MIN_OVERLAP
from graphvio.geometry import so3_exp
from graphvio.rig import Camera, Rig, axes_angle_deg, overlap
from graphvio.simulation import Simulator, build_scene, default_rig
from graphvio.simulation.named_rigs import headset, phone, surround
from graphvio.simulation.renderer import RenderedView
from graphvio.simulation.surfaces import Surfaces


def four_cameras() -> Rig:
    return default_rig().without_pairs().with_cameras(half_size)


def surrounding() -> Rig:
    return surround().with_cameras(half_size)


def fisheyes() -> Rig:
    return headset().without_pairs().with_cameras(half_size)


class OnceRendered(Simulator):
    """A simulator that renders a view once for its image and its depth, as long as the same frameset is wanted."""

    _index = -1

    def view(self, index: int, camera: int, surfaces: Surfaces | None = None) -> RenderedView:
        if index != self._index:
            self._index, self._views = index, dict[int, RenderedView]()
        if camera not in self._views:
            self._views[camera] = super().view(index, camera, surfaces)
        return self._views[camera]


def true_pixels(own: Camera, rays: Float, depths: Float, other: Camera) -> Float:
    """Project points of a camera, of known depth, into another one."""
    in_own = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None]
    other_T_own = other.cam_T_body @ own.body_T_cam
    return other.project(in_own @ other_T_own[:3, :3].T + other_T_own[:3, 3])[0]


class SurroundWalk(NamedTuple):
    """What cameras did with each other's tracks over a part of a walk in which the rig turns.

    Attributes:
        distances_px: of tracks that go on in another camera since the one that began the point has ended, from where
            the renderer has that point.
        least_distance_px: of a track to another one of its camera, when it was adopted.
        followed_twice: number of points of which a camera had two tracks.
    """

    distances_px: Float
    least_distance_px: float
    followed_twice: int


@pytest.fixture(scope="module")
def surround_walk() -> SurroundWalk:
    rig = surrounding()
    cameras = [single.left for single in rig.singles]
    simulator = OnceRendered(build_scene("room", 5.0, 0.0), rig, 1)
    frontend, poses, stamps = SinglesFrontend(rig, Config()), simulator.world_T_body, list(simulator.stamps_ns)
    in_world: dict[tuple[int, int], Float] = {}
    over: set[tuple[int, int]] = set()  # whose distance is noted at their first sight
    distances_px, apart_px, twice, known = [], [], 0, [np.zeros(0, dtype=np.int64)] * len(cameras)
    for k in range(60, 100):
        now_T_world = np.linalg.inv(poses[k])
        since = {int(then): np.ascontiguousarray(now_T_world @ pose) for then, pose in zip(stamps, poses, strict=True)}
        visual = frontend.process(simulator.frameset(k), since.__getitem__)
        frames = frontend.frames_at(stamps[k])
        for j, tracks in visual.camera_tracks.items():
            depth, world_T_cam = simulator.view(k, j).depth, poses[k] @ cameras[j].body_T_cam
            rows, begun_by, begun_as = tracks.handed_over
            columns, lines = np.rint(frames[j].pixels).astype(int).T
            points = np.column_stack([frames[j].left_rays, np.ones(len(columns))]) * depth[lines, columns][:, None]
            points = points @ world_T_cam[:3, :3].T + world_T_cam[:3, 3]
            own = np.setdiff1d(np.arange(len(columns)), rows)
            in_world |= {(j, int(tracks.ids[i])): points[i] for i in own}
            origins = list(zip(begun_by.tolist(), begun_as.tolist(), strict=True))
            twice += len(origins) - len(set(origins))
            for row, origin in zip(rows, origins, strict=True):
                if tracks.ids[row] not in known[j]:
                    others = np.delete(frames[j].pixels, row, axis=0)
                    apart_px.append(np.linalg.norm(others - frames[j].pixels[row], axis=1).min())
                track = (j, int(tracks.ids[row]))
                if origin[1] in visual.camera_tracks[origin[0]].ids or track in over:
                    continue
                over.add(track)
                in_cam = (in_world[origin] - world_T_cam[:3, 3]) @ world_T_cam[:3, :3]
                distances_px.append(np.linalg.norm(cameras[j].project(in_cam[None])[0][0] - frames[j].pixels[row]))
            known[j] = np.union1d(known[j], tracks.ids)
    frontend.close()
    return SurroundWalk(np.array(distances_px), min(apart_px), twice)


@pytest.mark.parametrize(("make_rig", "max_median_px"), [(four_cameras, 0.1), (surrounding, 0.2), (fisheyes, 0.2)])
def test_tracks_are_found_where_other_cameras_see_their_points(
    make_rig: Callable[[], Rig], max_median_px: float
) -> None:
    """At the first frameset they are searched for; at the second, of a rig that stands, they are found again."""
    rig = make_rig()
    cameras = [single.left for single in rig.singles]
    simulator = OnceRendered(build_scene("room", 2.0), rig, 1)
    frontend, counts = SinglesFrontend(rig, Config()), []
    depths = [simulator.view(0, j).depth for j in range(len(cameras))]
    for k in range(2):
        visual = frontend.process(simulator.frameset(k), lambda _: np.eye(4))
        errors, found = [], 0
        for j, tracks in visual.camera_tracks.items():
            frame = frontend.frames_at(simulator.stamps_ns[0] if k == 0 else simulator.stamps_ns[1])[j]
            columns, rows = np.rint(frame.pixels).astype(int).T
            for seen in tracks.matches:
                assert overlap(cameras[j], cameras[seen.camera]) >= MIN_OVERLAP
                assert make_rig is not surrounding or axes_angle_deg(cameras[j], cameras[seen.camera]) > 45.0
                of_own = depths[j][rows[seen.rows], columns[seen.rows]]
                other = cameras[seen.camera]
                in_other = np.column_stack([seen.rays, np.ones(len(seen.rays))])
                expected = true_pixels(cameras[j], tracks.rays[seen.rows], of_own, other)
                errors.append(np.linalg.norm(other.project(in_other)[0] - expected, axis=1))
                found += len(seen.rows)
        assert np.median(np.concatenate(errors)) < max_median_px
        assert np.mean(np.concatenate(errors) > 1.0) < 0.06  # some corners are of edges in depth
        counts.append(found)
    assert counts[0] > 20 * len(cameras)
    assert counts[1] > 0.9 * counts[0]
    frontend.close()


def test_near_points_that_cameras_see_from_different_sides_are_not_matched() -> None:
    def moved_out(camera: Camera) -> Camera:
        pose = camera.body_T_cam.copy()
        pose[:3, 3] *= 4.0
        return replace(camera, body_T_cam=pose)

    rig = surrounding().with_cameras(moved_out)
    cameras = [single.left for single in rig.singles]
    simulator = OnceRendered(build_scene("room", 1.0), rig, 1)
    frontend, parallax, n_near = SinglesFrontend(rig, Config()), [], 0
    visual = frontend.process(simulator.frameset(0), lambda _: np.eye(4))
    for j, tracks in visual.camera_tracks.items():
        columns, rows = np.rint(frontend.frames_at(simulator.stamps_ns[0])[j].pixels).astype(int).T
        depths = simulator.view(0, j).depth[rows, columns]
        for seen in tracks.matches:
            baseline_m = np.linalg.norm((cameras[seen.camera].cam_T_body @ cameras[j].body_T_cam)[:3, 3])
            parallax.append(baseline_m / depths[seen.rows])
            n_near += int((baseline_m / depths > 0.25).sum())
    frontend.close()
    matched = np.concatenate(parallax)
    assert len(matched) > 50
    assert n_near > 50  # of the tracks
    assert np.mean(matched > 0.25) < 0.02  # wrong matches


def turned_in_file(rig: Rig, degrees: float) -> Rig:
    """Return a rig file whose cameras are turned at random, and whose principal points are 2 px off."""
    rng = np.random.default_rng(3)

    def wrong(camera: Camera) -> Camera:
        turned = camera.body_T_cam.copy()
        turned[:3, :3] = turned[:3, :3] @ so3_exp(np.deg2rad(degrees) * rng.normal(size=3))
        fx, fy, cx, cy = camera.intrinsics
        return replace(camera, body_T_cam=turned, intrinsics=np.array([fx, fy, cx + 2.0, cy - 2.0]))

    return rig.with_cameras(wrong)


def matches_at_first_sight(frontend: SinglesFrontend, simulator: OnceRendered, file: Rig) -> tuple[int, Float]:
    """Return how many tracks are found in other cameras, and their distances, in pixels, from where they are."""
    cameras = [single.left for single in simulator.rig.singles]
    of_file = [single.left for single in file.singles]
    errors = [np.zeros(0)]
    for j, tracks in frontend.process(simulator.frameset(0), lambda _: np.eye(4)).camera_tracks.items():
        pixels = frontend.frames_at(simulator.stamps_ns[0])[j].pixels
        np.testing.assert_allclose(tracks.rays, of_file[j].unproject(pixels)[0], atol=1e-12)
        columns, rows = np.rint(pixels).astype(int).T
        depths = simulator.view(0, j).depth[rows, columns]
        for seen in tracks.matches:
            own_rays = cameras[j].unproject(pixels[seen.rows])[0]
            expected = true_pixels(cameras[j], own_rays, depths[seen.rows], cameras[seen.camera])
            there = of_file[seen.camera].project(np.column_stack([seen.rays, np.ones(len(seen.rays))]))[0]
            errors.append(np.linalg.norm(there - expected, axis=1))
    frontend.close()
    return sum(map(len, errors)), np.concatenate(errors)


def test_epipolar_lines_are_those_of_the_calibration_in_force_and_rays_those_of_the_rig_file() -> None:
    rig = four_cameras()
    file = turned_in_file(rig, 1.0)
    simulator = OnceRendered(build_scene("room", 1.0), rig, 1)
    found = {}
    for name, calibration in (("file", file), ("true", rig)):
        frontend = SinglesFrontend(file, Config())
        frontend.recalibrate(calibration, 0.0)
        found[name] = matches_at_first_sight(frontend, simulator, file)
    assert found["true"][0] > 4 * found["file"][0]
    assert np.median(found["true"][1]) < 0.1


def test_a_margin_finds_points_beside_the_epipolar_lines_of_a_file_that_is_a_little_wrong() -> None:
    rig = four_cameras()
    file = turned_in_file(rig, 0.2)
    simulator = OnceRendered(build_scene("room", 1.0), rig, 1)
    counts = []
    for margin_px in (0.0, 5.0):
        frontend = SinglesFrontend(file, Config())
        frontend.recalibrate(file, margin_px)
        count, errors = matches_at_first_sight(frontend, simulator, file)
        counts.append(count)
    assert counts[1] > 2 * counts[0]
    assert np.median(errors) < 0.3


def test_rolling_shutters_and_cameras_that_look_apart_share_nothing() -> None:
    rig = phone().with_cameras(half_size)
    simulator = OnceRendered(build_scene("room", 1.0), rig, 1)
    frontend = SinglesFrontend(rig, Config())
    assert frontend.process(simulator.frameset(0), lambda _: None).camera_tracks[0].matches == ()
    frontend.close()
    apart = default_rig().with_only(["cam0", "cam2"]).with_cameras(half_size)
    frontend = SinglesFrontend(apart, Config())
    frameset = OnceRendered(build_scene("room", 1.0), apart, 1).frameset(0)
    assert all(each.matches == () for each in frontend.process(frameset, lambda _: None).camera_tracks.values())
    frontend.close()


def test_a_point_that_leaves_one_camera_goes_on_in_another_as_the_same(surround_walk: SurroundWalk) -> None:
    """A track that took over is of the point that the ended track was of, by the renderer's depth."""
    assert len(surround_walk.distances_px) > 25
    assert np.median(surround_walk.distances_px) < 0.25
    assert np.mean(surround_walk.distances_px > 1.0) < 0.15  # corners of edges in depth, and mismatches


def test_a_camera_adopts_where_it_has_no_track(surround_walk: SurroundWalk) -> None:
    """No two tracks of a camera follow one point, and adopted tracks keep their distance to the others."""
    assert surround_walk.least_distance_px > 0.45 * Config().corners.cell_px(320)
    assert surround_walk.followed_twice == 0

"""The SLAM system on rendered images: loops, epochs, saved maps, and sessions that are located in them."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_walks import CONFIG, Refusing, front_end, mapped, simulator
from synthetic_front_end import SyntheticFrontEnd

from graphvio.arrays import Float
from graphvio.errors import MapError
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.mapping import saved_map
from graphvio.mapping.mapper import Mapper
from graphvio.rig import Rig
from graphvio.rig_files import load_rig
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.slam.keyframe import Keyframe
from graphvio.trajectory_files import load_trajectory, save_trajectory

pytest.importorskip("pycolmap", reason="maps need the extra maps")


@dataclass(frozen=True, eq=False)
class Made:
    front_end: SyntheticFrontEnd
    truth: Float
    mapper: Mapper
    folder: Path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A map of a round and a half."""
    folder = tmp_path_factory.mktemp("map") / "room"
    walk, truth = front_end(0, 240, seed=1)
    return Made(walk, se3_inverse(truth[0]) @ truth, mapped(walk, save=folder), folder)


@pytest.fixture
def copied(made: Made, tmp_path: Path) -> Path:
    """A copy of the map, to be damaged."""
    folder = tmp_path / "room"
    shutil.copytree(made.folder, folder)
    return folder


def count(mapper: Mapper, name: str) -> int:
    value = mapper.summary()[name]
    assert isinstance(value, int)
    return value


def far(poses: Float, truth: Float) -> Float:
    """Return the distances (N,) of positions, metres."""
    return np.asarray(np.linalg.norm((poses - truth)[:, :3, 3], axis=1))


def test_round_is_closed(made: Made) -> None:
    drift = far(made.front_end.odom_T_body, made.truth)
    found = made.mapper.trajectory
    assert len(found) == len(made.truth)
    error = far(found.nav_T_body, made.truth)
    assert drift[-1] > 0.03
    assert error[-1] < 0.2 * drift[-1]
    assert np.sqrt((error**2).mean()) < 0.7 * np.sqrt((drift**2).mean())
    summary = made.mapper.summary()
    used = sum(is_used for _, is_used in made.mapper.closures)
    assert summary["closures_used"] == used
    assert used >= 5
    assert summary["places_skipped"] == summary["corrections_refused"] == 0


def test_corrections_are_consistent(made: Made) -> None:
    assert len(made.front_end.corrections) >= 3
    squares = []
    for number, pose, covariance in made.front_end.corrections:
        error = se3_log(se3_inverse(pose) @ made.truth[number])
        squares.append(error @ np.linalg.solve(covariance, error))
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
    assert np.linalg.norm(error[3:]) < 0.005
    assert max(squares) < 40.0
    assert np.median(squares) < 12.0
    # How gravity lies in the first odom frame is uncertain by 15 mrad, and no matter of the map, which has that frame.
    assert all(np.sqrt(np.trace(covariance[:3, :3])) < 0.012 for _, _, covariance in made.front_end.corrections)


def test_used_closures_are_right(made: Made) -> None:
    row_of = {stamp: k for k, stamp in enumerate(made.mapper.trajectory.stamps_ns.tolist())}
    for closure, is_used in made.mapper.closures:
        one, other = (made.truth[row_of[end.stamp_ns]] for end in (closure.reference, closure.current))
        error = se3_log(se3_inverse(se3_inverse(one) @ other) @ closure.reference_T_current)
        assert not is_used or np.linalg.norm(error[3:]) < 0.03


class Calibrated(SyntheticFrontEnd):
    """Has a rig file that is wrong, and keyframes that have the true one."""

    def __init__(self, rig: Rig, *others: Any) -> None:
        wrong = draw(
            rig, CalibrationErrorSizes.of_level(3, ["left-right-rotation", "pair-transform"]), seed=1
        ).written_rig
        super().__init__(wrong, *others)
        self._true_rig = rig

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        for each in super().keyframes(from_id):
            yield replace(each, calibrated_rig=self._true_rig)


def test_places_are_seen_with_the_calibration_of_their_keyframe(made: Made, tmp_path: Path) -> None:
    walk, _ = front_end(0, 240, seed=1, kind=Calibrated)
    found = mapped(walk, save=tmp_path / "room")
    np.testing.assert_array_equal(found.trajectory.nav_T_body, made.mapper.trajectory.nav_T_body)
    saved = load_rig(tmp_path / "room" / "rig.yaml")  # that with which the map is asked for the next time
    np.testing.assert_allclose(saved.left2_T_left1(), walk.rig.left2_T_left1(), atol=1e-9)


class CalibratedLater(SyntheticFrontEnd):
    """Has a rig file in which all cameras are turned in body; the true rig is in force from the first second on."""

    TURN = se3_exp(np.array([0.01, -0.006, 0.015, 0.004, -0.002, 0.003]))
    CORRECTED_AT = 6

    def __init__(self, rig: Rig, *others: Any) -> None:
        turned = rig.with_cameras(lambda camera: replace(camera, body_T_cam=self.TURN @ camera.body_T_cam))
        super().__init__(turned, *others)
        self._true_rig = rig

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        for each in super().keyframes(from_id):
            now, before = self.true_T_body(each.id), self.true_T_body(each.id - 1)
            motion, covariance = each.previous_T_body, each.relative_covariance
            if motion is not None and covariance is not None:
                adjoint = se3_adjoint(se3_inverse(now))
                motion, covariance = se3_inverse(before) @ motion @ now, adjoint @ covariance @ adjoint.T
            yield replace(
                each,
                odom_T_body=each.odom_T_body @ now,
                previous_T_body=motion,
                relative_covariance=covariance,
                calibrated_rig=None if each.id < self.CORRECTED_AT else self._true_rig,
            )

    def true_T_body(self, number: int) -> Float:
        return np.eye(4) if number >= self.CORRECTED_AT else se3_inverse(self.TURN)


def test_places_from_before_a_correction_of_the_calibration_close_loops(made: Made, tmp_path: Path) -> None:
    walk, _ = front_end(0, 240, seed=1, kind=CalibratedLater)
    assert isinstance(walk, CalibratedLater)
    mapper = mapped(walk, save=tmp_path / "room")
    found, expected = mapper.trajectory, made.mapper.trajectory
    by_true_rig = [pose @ se3_inverse(walk.true_T_body(k)) for k, pose in enumerate(found.nav_T_body)]
    np.testing.assert_allclose(by_true_rig, expected.nav_T_body, atol=2e-4)
    assert count(mapper, "closures_used") == count(made.mapper, "closures_used")
    saved = saved_map.load(tmp_path / "room", walk.rig, CONFIG)
    np.testing.assert_array_equal(saved.body_T_camera[0], walk.rig.pairs[0].left.body_T_cam)
    np.testing.assert_array_equal(saved.body_T_camera[-1], made.front_end.rig.pairs[0].left.body_T_cam)


def test_saved_map_is_complete(made: Made) -> None:
    header = json.loads((made.folder / "map.json").read_text())
    assert (header["format"], header["version"]) == ("graphvio map", 3)
    assert header["places"] == made.mapper.summary()["places"]
    assert {path.name for path in made.folder.parent.iterdir()} == {"room"}  # nothing unfinished is left


def test_session_is_located_in_a_map_of_few_places(tmp_path: Path) -> None:
    """There were too few for a vocabulary while it was made."""
    few = mapped(front_end(0, 30, seed=1)[0], save=tmp_path / "few")
    assert count(few, "places") < 6
    again = mapped(front_end(2, 26, seed=2, session=1)[0], tmp_path / "few")
    assert count(again, "places_in_map_frame") == count(few, "places") + count(again, "places")
    assert count(again, "closures_used") >= 3


@pytest.mark.parametrize("first", [40, 112])
def test_another_session_is_located_in_the_map(made: Made, tmp_path: Path, first: int) -> None:
    """From two places of the map; a third session would find both."""
    walk, truth = front_end(first, first + 49, seed=2, step=2, session=1)
    again = mapped(walk, made.folder, save=tmp_path / "both")
    in_map = se3_inverse(front_end(0, 1, seed=0)[1][0]) @ truth
    assert again.trajectory.stamps_ns[-1] >= again._places[-1].stamp_ns
    number, pose, covariance = walk.corrections[0]
    assert number <= 12
    error = se3_log(se3_inverse(pose) @ in_map[number])
    assert error @ np.linalg.solve(covariance, error) < 40.0
    # The map has drifted itself where no loop holds it: what counts is where the newest place is among its places.
    stamps = made.mapper.trajectory.stamps_ns.tolist()
    was = np.array([made.truth[stamps.index(place.stamp_ns)] for place in again._places if place.session == 0])
    newest = in_map[again.trajectory.stamps_ns.tolist().index(again._places[-1].stamp_ns)]
    nearest = int(np.argmin(far(was, newest)))
    found = se3_inverse(again.place_poses[nearest]) @ again.place_poses[-1]
    assert far(found[None], (se3_inverse(was[nearest]) @ newest)[None])[0] < 0.01
    header = json.loads((tmp_path / "both" / "map.json").read_text())
    assert header["sessions"] == 2
    assert header["places"] == len(again.place_poses) > count(made.mapper, "places")
    np.testing.assert_allclose(again.place_poses[0], np.eye(4), atol=1e-4)


def test_nothing_is_corrected_before_three_places_agree(made: Made) -> None:
    """The session's first places only: the first one is recognised, which is not enough."""
    walk, _ = front_end(40, 43, seed=2, step=2, session=1)
    again = mapped(walk, made.folder)
    assert count(again, "closures_found") > count(made.mapper, "closures_found")
    assert not walk.corrections
    assert len(again.trajectory) == 0


def test_new_epoch_is_located_in_the_map(tmp_path: Path) -> None:
    """Its keyframes are not in the trajectory until then; afterwards all of them are."""
    walk, truth = front_end(0, 200, seed=3, breaks={40}, kind=Refusing)
    mapper = mapped(walk)
    assert min(number for number, _, _ in walk.corrections if number >= 40) > 41  # three places must agree
    assert count(mapper, "corrections_sent") == count(mapper, "corrections_refused") == len(walk.corrections) > 1
    assert mapper.summary()["last_refusal"] == "too far off"
    assert mapper.trajectory.stamps_ns[-1] >= mapper._places[-1].stamp_ns
    found = mapper.trajectory
    assert len(found) == len(truth)
    assert far(found.nav_T_body[-1:], (se3_inverse(truth[0]) @ truth)[-1:])[0] < 0.06
    save_trajectory(found, tmp_path / "map.txt")
    assert len(load_trajectory(tmp_path / "map.txt")) == len(truth)


def test_map_of_another_rig_raises(made: Made) -> None:
    walk, _ = front_end(0, 4, seed=0)
    left = walk.rig.pairs[0].left
    moved = replace(left, intrinsics=left.intrinsics + 1.0)
    pairs = (replace(walk.rig.pairs[0], left=moved), *walk.rig.pairs[1:])
    other = SyntheticFrontEnd(replace(walk.rig, pairs=pairs), [], np.zeros((0, 4, 4)), walk._frameset_at, (0.0, 0.0), 0)
    with pytest.raises(MapError, match=r"another rig .intrinsics of cam0 differ"):
        Mapper(other, CONFIG, made.folder)


@pytest.mark.parametrize("name", ["map.npz", "closures.npz", "features.db"])
def test_damaged_map_raises(copied: Path, name: str) -> None:
    data = bytearray((copied / name).read_bytes())
    data[len(data) // 2] ^= 0xFF
    (copied / name).write_bytes(data)
    with pytest.raises(MapError, match=f"{name}: is damaged or missing"):
        Mapper(front_end(0, 4, seed=0)[0], CONFIG, copied)
    (copied / name).unlink()
    with pytest.raises(MapError, match=f"{name}: is damaged or missing"):
        Mapper(front_end(0, 4, seed=0)[0], CONFIG, copied)


def test_folder_without_a_map_raises(copied: Path, tmp_path: Path) -> None:
    walk, _ = front_end(0, 4, seed=0)
    with pytest.raises(MapError, match=r"is no map, map.json is missing"):
        Mapper(walk, CONFIG, tmp_path)
    header = json.loads((copied / "map.json").read_text())
    (copied / "map.json").write_text(json.dumps(header | {"version": 99}))
    with pytest.raises(MapError, match="of version 99, this graphvio reads 3"):
        Mapper(walk, CONFIG, copied)
    (copied / "map.json").write_text("{")
    with pytest.raises(MapError, match=r"map.json: is damaged"):
        Mapper(walk, CONFIG, copied)


def test_other_files_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with (
        Mapper(front_end(0, 4, seed=0)[0], CONFIG) as mapper,
        pytest.raises(MapError, match="contains other files than a map"),
    ):
        mapper.save(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_other_files_in_a_maps_folder_stay(tmp_path: Path) -> None:
    mine = {"notes.txt": "mine", "online.txt": "an earlier path"}
    (tmp_path / "link").symlink_to(tmp_path / "map")
    with Mapper(front_end(0, 4, seed=0)[0], CONFIG) as mapper:
        mapper.save(tmp_path / "map")
        for name, text in mine.items():
            (tmp_path / "map" / name).write_text(text)
        (tmp_path / "map" / "photos").mkdir()
        (tmp_path / "map" / "photos" / "door.jpg").write_bytes(b"door")
        mapper.run()
        mapper.save(tmp_path / "map")
        mapper.save(tmp_path / "link")
    assert json.loads((tmp_path / "map" / "map.json").read_text())["places"] == 1
    assert {name: (tmp_path / "map" / name).read_text() for name in mine} == mine
    assert (tmp_path / "map" / "photos" / "door.jpg").read_bytes() == b"door"
    assert {path.name for path in tmp_path.iterdir()} == {"map", "link"}
    assert (tmp_path / "link").is_symlink()


def test_map_before_a_failure_can_be_saved(tmp_path: Path) -> None:
    work = tmp_path / "work"
    work.mkdir()

    def obstruct(mapper: Mapper) -> None:
        """No image can be written where its folder should be."""
        if mapper.summary()["places"] == 3:
            shutil.rmtree(work / "images")
            (work / "images").touch()

    with Mapper(front_end(0, 120, seed=1)[0], CONFIG, folder=work) as mapper:
        with pytest.raises(MapError, match="a place cannot be stored"):
            mapper.run(obstruct)
        mapper.save(tmp_path / "map")
    assert not work.exists()
    with Mapper(front_end(0, 4, seed=0)[0], CONFIG, tmp_path / "map") as again:
        assert again.summary()["places_of_map"] == 3


def test_stop_ends_run_and_the_map_can_be_saved(tmp_path: Path) -> None:
    walk, _ = front_end(0, 240, seed=1)
    with Mapper(walk, CONFIG) as mapper:
        mapper.run(lambda each: each.stop())
        assert mapper.summary()["places"] == 1
        mapper.save(tmp_path / "one")
        mapper.save(tmp_path / "one")
        kept = mapper._folder
    assert json.loads((tmp_path / "one" / "map.json").read_text())["places"] == 1
    assert not kept.exists()
    with Mapper(front_end(0, 4, seed=0)[0], CONFIG, tmp_path / "one") as again:
        assert again.summary()["places_of_map"] == 1


def test_map_can_be_saved_during_run(tmp_path: Path) -> None:
    """Repeatedly from another thread; each map is complete."""
    walk, _ = front_end(0, 60, seed=1)
    sizes: list[int] = []
    with Mapper(walk, CONFIG) as mapper:
        walk.has_room = lambda: mapper.summary()["places_waiting"] in (0, 1)
        worker = threading.Thread(target=mapper.run)
        worker.start()
        while worker.is_alive():
            mapper.save(tmp_path / "now")
            sizes.append(len(saved_map.load(tmp_path / "now", walk.rig, CONFIG).places))
        worker.join()
        mapper.save(tmp_path / "now")
    assert sizes == sorted(sizes)
    assert len(saved_map.load(tmp_path / "now", walk.rig, CONFIG).places) == count(mapper, "places") > 3


def test_empty_map_can_be_saved_and_used(tmp_path: Path) -> None:
    with Mapper(front_end(0, 4, seed=0)[0], CONFIG) as mapper:
        mapper.save(tmp_path / "empty")
        assert len(mapper.trajectory) == 0
    with Mapper(front_end(0, 4, seed=0)[0], CONFIG, tmp_path / "empty") as again:
        again.run()
        assert again.trajectory.stamps_ns[-1] >= again._places[-1].stamp_ns


@pytest.mark.parametrize("cameras", [["cam0"], ["cam0", "cam2"]])
def test_round_of_single_cameras_is_closed(cameras: list[str]) -> None:
    """Of one camera, and of two that look opposite ways: depths come from the motion between places."""
    rig = simulator().rig.without_pairs().with_only(cameras)
    walk, truth = front_end(0, 240, seed=1, rig=rig, sigmas=(np.deg2rad(0.1), 0.01))
    truth = se3_inverse(truth[0]) @ truth
    mapper = mapped(walk)
    drift, error = far(walk.odom_T_body, truth), far(mapper.trajectory.nav_T_body, truth)
    assert count(mapper, "closures_used") >= 5
    assert error[-1] < 0.25 * drift[-1]
    assert np.sqrt((error**2).mean()) < 0.7 * np.sqrt((drift**2).mean())
    row_of = {stamp: k for k, stamp in enumerate(mapper.trajectory.stamps_ns.tolist())}
    squares = []
    for closure, is_used in mapper.closures:
        one, other = (truth[row_of[end.stamp_ns]] for end in (closure.reference, closure.current))
        error = se3_log(se3_inverse(se3_inverse(one) @ other) @ closure.reference_T_current)
        squares.append(error @ np.linalg.solve(closure.covariance, error))
        assert not is_used or np.linalg.norm(error[3:]) < 0.1
    assert np.mean(squares) < 9.0
    assert len(walk.corrections) >= 3

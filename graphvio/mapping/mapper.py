"""The SLAM system: recognises places, optimises the pose graph and corrects the odometry."""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from graphvio.arrays import AnyArray, Float
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.geometry import se3_inverse
from graphvio.mapping import saved_map
from graphvio.mapping.intake import Intake
from graphvio.mapping.places import NewPlace, spread_keyframes
from graphvio.mapping.pose_graph import PoseGraph
from graphvio.mapping.recognition import Recognition
from graphvio.mapping.store import DATABASE, PlaceStore, copy_database
from graphvio.measurements.sensors import FrameSet
from graphvio.optimization.loops.closures import LoopClosure, Place, closure_of
from graphvio.optimization.loops.features import PlaceObserver
from graphvio.optimization.loops.motion_depth import NEIGHBOURS, PlaceMotion
from graphvio.optimization.loops.verification import FreshView, PlaceView, crossings, verified
from graphvio.rig import Rig
from graphvio.slam.interface import SlamFrontEnd
from graphvio.trajectory import Trajectory

_SEARCHING_SHARE = 0.25  # of the distance between places, while a fragment is not yet located in the map
_MAX_SEARCHING_PLACES = 20  # first places of a fragment that are denser: more would not locate it sooner


class Mapper:
    """Makes a map from a front-end's keyframes, and corrects the front-end; a context manager.

    The map's frame is the odom frame of the first epoch, or the frame of the loaded map. A later epoch, or a session in
    a loaded map, is a separate fragment until closures of three of its places agree on its transform; only then is the
    front-end corrected.

    Args:
        front_end: The front-end, such as `graphvio.slam.FrontEnd`; its keyframes must have images.
        config: The configuration, whose section ``optimization`` has the settings of places and closures.
        map: Folder of a saved map to begin with, or None.
        folder: Empty folder for temporary files, removed by `close`; None for one in the system's folder.

    Raises:
        MapError: If the map cannot be used with the front-end's rig.
        MissingExtraError: If the extra ``maps`` is not installed.
    """

    def __init__(
        self, front_end: SlamFrontEnd, config: Config, map: Path | str | None = None, folder: Path | None = None
    ) -> None:
        self._front_end = front_end
        self._config = config
        self._folder = Path(tempfile.mkdtemp(prefix="graphvio-map-")) if folder is None else folder
        try:
            self._begin(None if map is None else Path(map))
        except BaseException:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise

    def _begin(self, folder: Path | None) -> None:
        settings = self._config.optimization
        self._graph = PoseGraph(settings.loop_probability)
        self._recognition = Recognition(self._config.motion.seed)
        self._places: list[Place] = []
        self._body_T_camera: list[Float] = []  # pose of the first camera, with the calibration in force at each place
        if folder is not None:
            kept = saved_map.load(folder, self._front_end.rig, self._config)
            copy_database(folder / DATABASE, self._folder / DATABASE)
            self._graph, self._recognition = kept.graph, kept.recognition
            self._places, self._body_T_camera = list(kept.places), list(kept.body_T_camera)
        self._first = len(self._places)  # first place of this session
        self._session = 1 + max((place.session for place in self._places), default=-1)
        self._store = PlaceStore(self._folder, self._front_end.rig)
        self._observer = PlaceObserver(self._front_end.rig, self._config)
        self._share = _SEARCHING_SHARE if self._first else 1.0  # of the configured distance between places
        self._intake = Intake(self._front_end, settings, lambda: self._share)
        self._keyframe_ids: list[int] = []
        self._lock = threading.RLock()  # held while the graph changes, or is read in another thread
        self._working = threading.Lock()  # held while a place is processed
        self._is_stopped = False
        self._times = _StageTimes()
        self._tried = 0
        self._sent = 0
        self._refused: list[str] = []
        if self._first and not self._recognition.words.size:  # the map had too few places for a vocabulary
            self._recognition.learn(self._descriptors)

    def __enter__(self) -> Mapper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, on_place: Callable[[Mapper], None] | None = None) -> None:
        """Process places until the front-end's keyframes end, or `stop` is called; ``on_place`` is called after each.

        Raises:
            GraphvioError: If the front-end fails, or a place cannot be stored. The map until then can be saved.
        """
        self._intake.start()
        while not self._is_stopped and (place := self._intake.next()) is not None:
            with self._working:
                self._take(place)
            if on_place is not None:
                on_place(self)

    def stop(self) -> None:
        """End `run` after the current place; thread-safe."""
        self._is_stopped = True
        self._intake.stop()

    def close(self) -> None:
        """Delete the temporary files; `save` has to be called before to keep the map."""
        self.stop()
        with self._working:
            self._store.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def save(self, folder: Path | str) -> None:
        """Write the map to a folder, where it replaces an older map; thread-safe, runs between two places.

        Raises:
            MapError: If the folder contains other files, or cannot be written.
        """
        with self._working, self._lock:
            kept = saved_map.SavedMap(self._graph, self._recognition, self._places, self._body_T_camera)
            saved_map.save(kept, self._store, self._front_end.rig, Path(folder))

    @property
    def trajectory(self) -> Trajectory:
        """Optimised poses, in the map's frame, of this session's keyframes that are located in it."""
        with self._lock:
            poses = [
                self._graph.pose(k) if self._graph.is_in_map(k) else None for k in range(self._first, len(self._graph))
            ]
            begins = {place - self._first for place in self._graph.chains.first_places}
            motions = self._graph.chains.motions[self._first :]
        return spread_keyframes(self._intake.keyframes, poses, motions, begins)

    @property
    def place_poses(self) -> Float:
        """(N, 4, 4) poses of all places in the map, including earlier sessions."""
        with self._lock:
            poses = [self._graph.pose(k) for k in range(len(self._graph)) if self._graph.is_in_map(k)]
        return np.array(poses).reshape(-1, 4, 4)

    @property
    def closures(self) -> list[tuple[LoopClosure, bool]]:
        """All closures, and whether the solution uses each; rows of their places are indices of the map's places."""
        with self._lock:
            return [(each.closure, each.is_used) for each in self._graph.closures]

    def summary(self) -> Mapping[str, float | int | str | None]:
        """Return the figures of the run by name."""
        with self._lock:
            in_map = sum(self._graph.is_in_map(k) for k in range(len(self._graph)))
            found, used = len(self._graph.closures), sum(each.is_used for each in self._graph.closures)
            return {
                "keyframes": len(self._intake.keyframes),
                "keyframes_lost": self._intake.lost,
                "places": len(self._graph) - self._first,
                "places_of_map": self._first,
                "places_in_map_frame": in_map,
                "places_skipped": self._intake.skipped,
                "places_waiting": self._intake.waiting,
                "candidates_tried": self._tried,
                "closures_found": found,
                "closures_used": used,
                "corrections_sent": self._sent,
                "corrections_refused": len(self._refused),
                "last_refusal": self._refused[-1] if self._refused else None,
            } | self._times.summary()

    def _take(self, new: NewPlace) -> None:
        keyframe, clock = new.keyframe, self._times
        rig = keyframe.calibrated_rig or self._front_end.rig
        if rig is not self._store.rig:  # use the calibration in force for this place and the stored ones
            self._store.rig, self._observer = rig, PlaceObserver(rig, self._config)
        frameset = FrameSet(keyframe.stamp_ns, keyframe.images)
        with clock.stage("features"):
            seen = self._observer.look(frameset)
        with clock.stage("keep"):
            self._store.add(self._name(self._session), frameset, seen)
        number = len(self._graph)
        with clock.stage("description"):
            self._recognition.add({j: each.descriptors for j, each in seen.items()})
        with self._lock:
            self._places.append(Place(self._session, number, keyframe.stamp_ns))
            self._body_T_camera.append(_body_T_camera(self._store.rig))
            self._keyframe_ids.append(keyframe.id)
            # The graph comes last: after an interruption, the places that it contains are saved.
            if new.previous_T_body is None or new.covariance is None:
                self._graph.begin(keyframe.odom_T_body)
            else:
                self._graph.add(new.previous_T_body, new.covariance)
        if number == 0:
            self._correct(number)  # the map begins here
        with clock.stage("retrieval"):
            similar = self._recognition.similar(number, self._may, self._config.optimization.loop_candidates)
        found = []
        for earlier in similar:
            with clock.stage("verification"):
                closure = self._verified(earlier, number, FreshView(self._store.rig, frameset, seen))
            self._tried += 1
            if closure is not None:
                found.append(closure)
        if found:
            self._close_loops(found, number)
        first = self._graph.chains.first_places[-1]
        is_searching = not self._graph.is_in_map(first) and len(self._graph) - first < _MAX_SEARCHING_PLACES
        self._share = _SEARCHING_SHARE if is_searching else 1.0
        if self._recognition.is_due:
            with clock.stage("vocabulary"):
                self._recognition.learn(self._descriptors)

    def _may(self, earlier: int) -> bool:
        """Return whether a place may be compared with the newest one."""
        one, newest = self._places[earlier], self._places[-1]
        if not self._graph.may_see(earlier, newest.row):
            return False
        chains = self._graph.chains
        if one.session != newest.session or chains.fragment(earlier) != len(chains.first_places) - 1:
            return True
        return abs(newest.stamp_ns - one.stamp_ns) > round(self._config.optimization.loop_interval_s * 1e9)

    def _verified(self, earlier: int, later: int, view: FreshView) -> LoopClosure | None:
        one, recognition = self._places[earlier], self._recognition
        images = [(recognition.pairs(place), recognition.vectors(place)) for place in (earlier, later)]
        tried = crossings(*images[0], *images[1])
        seed = [self._config.motion.seed, earlier, later]
        stored = self._store.view(self._name(one.session), one.stamp_ns)
        neighbours = partial(self._neighbours, earlier)
        found = verified(stored, view, tried, self._observer.pairs, self._config, seed, neighbours)
        if found is None:
            return None
        closure = closure_of(one, self._places[later], found)
        return replace(closure, reference_T_current=self._body_T_body_now(earlier) @ closure.reference_T_current)

    def _body_T_body_now(self, place: int) -> Float:
        """Return the pose (4, 4) of body by the present calibration, in body by the calibration in force at a place.

        The poses of places refer to body by the calibration of their time, and motions that are measured between places
        to body by the present one. The poses of the cameras do not depend on this.
        """
        return np.asarray(self._body_T_camera[place] @ se3_inverse(_body_T_camera(self._store.rig)))

    def _neighbours(self, number: int) -> list[tuple[PlaceView, PlaceMotion]]:
        """Return the places next to a place in its fragment, and the motions to them."""
        found: list[tuple[PlaceView, PlaceMotion]] = []
        chains = self._graph.chains
        for other in (number + step for step in NEIGHBOURS):
            if 0 <= other < len(chains) and chains.fragment(other) == chains.fragment(number):
                place = self._places[other]
                view = self._store.view(self._name(place.session), place.stamp_ns)
                motion, covariance = chains.motion(number, other)
                motion = se3_inverse(self._body_T_body_now(number)) @ motion @ self._body_T_body_now(other)
                found.append((view, PlaceMotion(motion, covariance)))
        return found

    def _close_loops(self, found: list[LoopClosure], number: int) -> None:
        with self._times.stage("graph"), self._lock:
            is_changed = self._graph.add_closures(found) and self._graph.is_in_map(number)
        if is_changed:
            self._correct(number)

    def _correct(self, number: int) -> None:
        """Send the front-end the pose in the map of a place of this session."""
        with self._lock:
            pose, covariance = self._graph.pose(number), self._graph.covariance(number)
        self._sent += 1
        try:
            result = self._front_end.correct(self._keyframe_ids[number - self._first], pose, covariance)
        except GraphvioError as error:  # also if the front-end has ended, which `Intake` notices
            self._refused.append(str(error))
            return
        if not result.accepted:
            self._refused.append(result.reason)

    def _descriptors(self, place: int, j: int) -> AnyArray:
        of = self._places[place]
        return self._store.descriptors(self._name(of.session), of.stamp_ns, j)

    @staticmethod
    def _name(session: int) -> str:
        return f"session{session}"


def _body_T_camera(rig: Rig) -> Float:
    """Return the pose (4, 4) of a rig's first camera in body; those of the others are known relative to it."""
    return rig.groups[0].left.body_T_cam


class _StageTimes:
    """Processing times by stage, in the order in which the stages were first entered."""

    def __init__(self) -> None:
        self._total_s: dict[str, float] = {}
        self._count: dict[str, int] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time inside the context to a stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._total_s[name] = self._total_s.get(name, 0.0) + time.perf_counter() - begin
            self._count[name] = self._count.get(name, 0) + 1

    def summary(self) -> dict[str, float]:
        """Return the mean time of each stage, milliseconds."""
        return {f"{name}_ms": 1e3 * total / self._count[name] for name, total in self._total_s.items()}

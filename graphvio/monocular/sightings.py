"""Views of the tracks of single cameras from a window's states, and their association with landmarks.

A long track becomes a chain of landmarks, each seen from a limited number of keyframes. When the oldest keyframe leaves
the window, the landmarks that it sees have all their views in the window, and are eliminated with it: each view counts
once. The limit differs from track to track, so that only few tracks begin a new landmark at the same time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.measurements.motion import GLOBAL_SHUTTER, CameraTracks
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.structure import PRIOR_INVERSE_DEPTH, Structure

_NONE: Int = np.zeros(0, dtype=np.int64)
_MIX = 2654435761  # multiplier of Knuth's hash: limits do not depend on the order of tracks


class Views(NamedTuple):
    """M views from one state in the images of all cameras, each of a track that is associated with a landmark.

    Attributes:
        camera: (M,) index of the camera whose image it is.
        owner: (M,) index of the camera whose track it is.
        ids: (M,) identity of the track.
        landmark: (M,) identity of the landmark.
        rays: (M, 2) normalised coordinates.
        readout: (M, 4) see `graphvio.measurements.motion.CameraTracks`; zero for global shutters.
        is_adopted: (M,) whether the track follows a point that another camera's track began.
    """

    camera: Int
    owner: Int
    ids: Int
    landmark: Int
    rays: Float
    readout: Float
    is_adopted: Bool

    def without(self, landmarks: Int) -> Views:
        """Return the views of all but some landmarks."""
        return self._rows(~np.isin(self.landmark, landmarks))

    def without_adopted(self, landmarks: Int, cameras: Int) -> Views:
        """Return all views but those by adopted tracks of some landmarks (K,), each in one camera (K,)."""
        width = int(max(self.camera.max(initial=0), cameras.max(initial=0))) + 1
        named = np.isin(self.landmark * width + self.camera, landmarks * width + cameras)
        return self._rows(~(self.is_adopted & named))

    def without_cameras(self, cameras: Set[int]) -> Views:
        """Return the views in the images of all but some cameras."""
        return self._rows(~np.isin(self.camera, sorted(cameras)))

    def once(self, ranks: Int) -> Views:
        """Return at most one view of each landmark per camera: of several, that with the smallest rank (M,)."""
        order = np.lexsort((self.owner, ranks, self.camera, self.landmark))
        camera, landmark = self.camera[order], self.landmark[order]
        again = np.zeros(len(order), dtype=bool)
        again[order[1:]] = (camera[1:] == camera[:-1]) & (landmark[1:] == landmark[:-1])
        return self._rows(~again)

    def _rows(self, kept: Bool) -> Views:
        if kept.all():
            return self
        return Views(
            self.camera[kept], self.owner[kept], self.ids[kept], self.landmark[kept],
            np.compress(kept, self.rays, axis=0), np.compress(kept, self.readout, axis=0), self.is_adopted[kept],
        )  # fmt: skip


_NO_VIEWS = Views(_NONE, _NONE, _NONE, _NONE, np.zeros((0, 2)), GLOBAL_SHUTTER, np.zeros(0, dtype=bool))


class LandmarkIds:
    """Associates tracks with landmarks: tracks of several cameras that follow one point share a landmark.

    Args:
        n_cameras: number of cameras of the rig.
        max_keyframes: largest number of keyframes that see one landmark.
    """

    def __init__(self, n_cameras: int, max_keyframes: int) -> None:
        self._n_cameras = n_cameras
        self._max_keyframes = max_keyframes
        self._points: Int = _NONE  # increasing, see `_points_of`
        self._landmarks: Int = _NONE
        self._left: Int = _NONE  # keyframes that may still see each landmark
        self._cameras: Int = _NONE  # index of the camera that saw each point last
        self._tracks = (_NONE, _NONE, _NONE)  # camera, identity and landmark of the newest tracks
        self._next = 0

    def join(self, camera_tracks: Mapping[int, CameraTracks]) -> Views:
        """Associate the tracks of an instant with landmarks; points without a landmark begin a new one."""
        ordered = sorted(camera_tracks.items())
        if not ordered:
            return _NO_VIEWS
        of_tracks = [self._points_of(j, tracks) for j, tracks in ordered]
        ids = np.concatenate([tracks.ids for _, tracks in ordered])
        cameras = np.concatenate([np.full(len(tracks.ids), j, dtype=np.int64) for j, tracks in ordered])
        landmarks = self._landmarks_of(np.concatenate(of_tracks), ids, cameras, np.array([j for j, _ in ordered]))
        self._tracks = cameras, ids, landmarks
        parts, ranks, begin = [], [], 0
        for j, tracks in ordered:
            n = len(tracks.ids)
            named, own, rank = landmarks[begin : begin + n], np.full(n, j, dtype=np.int64), np.zeros(n, dtype=np.int64)
            rank[tracks.handed_over.rows] = 2
            begin += n
            readout = tracks.readout if len(tracks.readout) else np.zeros((n, 4))
            parts.append(Views(own, own, tracks.ids, named, tracks.rays, readout, rank > 0))
            ranks.append(rank)
            for seen in tracks.matches:
                rows, other = seen.rows, np.full(len(seen.rows), seen.camera, dtype=np.int64)
                is_adopted, global_shutter = rank[rows] > 0, np.zeros((len(rows), 4))
                parts.append(
                    Views(other, own[rows], tracks.ids[rows], named[rows], seen.rays, global_shutter, is_adopted)
                )
                ranks.append(rank[rows] + 1)
        views = Views(*(np.concatenate(each) for each in zip(*parts, strict=True)))
        return views.once(np.concatenate(ranks))

    def note_keyframe(self) -> None:
        """Record that the newest frameset is a keyframe."""
        self._left = self._left - 1

    def end(self, landmarks: Int) -> None:
        """End some landmarks: tracks that continue begin new ones."""
        self._left = np.where(np.isin(self._landmarks, landmarks), 0, self._left)

    def tracks_of(self, landmarks: Int) -> dict[int, Int]:
        """Return the newest tracks of some landmarks: camera -> identities, increasing."""
        ended = np.isin(self._tracks[2], landmarks)
        cameras, ids = self._tracks[0][ended], self._tracks[1][ended]
        return {int(j): np.unique(ids[cameras == j]) for j in np.unique(cameras)}

    def _points_of(self, camera: int, tracks: CameraTracks) -> Int:
        """Return numbers (N,) of the points that a camera's tracks follow, by the camera and track that began each."""
        points = tracks.ids * self._n_cameras + camera
        rows, cameras, ids = tracks.handed_over
        points[rows] = ids * self._n_cameras + cameras
        return points

    def _landmarks_of(self, of_tracks: Int, ids: Int, cameras: Int, present: Int) -> Int:
        """Return the landmarks (N,) of tracks, and forget points that the cameras with images no longer see.

        Args:
            of_tracks: (N,) numbers of the points that the tracks follow.
            ids: (N,) identities of the tracks.
            cameras: (N,) index of the camera that each track belongs to.
            present: indices of the cameras that have images.
        """
        points, firsts, which = np.unique(of_tracks, return_index=True, return_inverse=True)
        landmarks, left = np.full(len(points), -1, dtype=np.int64), np.zeros(len(points), dtype=np.int64)
        if len(self._points):
            rows = np.minimum(np.searchsorted(self._points, points), len(self._points) - 1)
            known = (self._points[rows] == points) & (self._left[rows] > 0)
            landmarks[known], left[known] = self._landmarks[rows[known]], self._left[rows[known]]
        new = np.flatnonzero(landmarks < 0)
        new = new[np.argsort(firsts[new])]  # in the order of cameras and tracks
        landmarks[new] = self._next + np.arange(len(new))
        self._next += len(new)
        shortest = (self._max_keyframes + 1) // 2
        mixed = (ids[firsts[new]] * _MIX + landmarks[new] * 40503) % 2**32 >> 16
        left[new] = shortest + mixed % (self._max_keyframes - shortest + 1)
        kept = ~np.isin(self._cameras, present) & ~np.isin(self._points, points)
        columns = (points, landmarks, left, cameras[firsts])
        before = (self._points, self._landmarks, self._left, self._cameras)
        both = [np.concatenate([now, then[kept]]) for now, then in zip(columns, before, strict=True)]
        order = np.argsort(both[0])
        self._points, self._landmarks, self._left, self._cameras = (column[order] for column in both)
        return np.asarray(landmarks[which])


class Landmarks:
    """Estimated positions of landmarks, by the landmarks' identities."""

    def __init__(self) -> None:
        self._ids: Int = np.zeros(0, dtype=np.int64)
        self._places = np.zeros((0, 3))
        self._frames = np.zeros((0, 4, 4))

    def structure(self, views: Sequence[Views], poses: Float, cameras: Cameras) -> tuple[Structure, Float, Int]:
        """Collect the landmarks that have at least two views, from two states or in two cameras.

        Args:
            views: views from the K states, in time order.
            poses: (K, 4, 4) ``odom_T_body``.
            cameras: cameras of the rig.

        Returns:
            The structure, the landmarks (L, 3), and their identities (L,).
        """
        landmark = np.concatenate([each.landmark for each in views])
        state = np.concatenate([np.full(len(each.landmark), k) for k, each in enumerate(views)])
        camera = np.concatenate([each.camera for each in views])
        rays, readout = (np.concatenate([getattr(each, name) for each in views]) for name in ("rays", "readout"))
        order = np.argsort((landmark * len(views) + state) * len(cameras.body_T_cam) + camera)  # these are unique
        landmark = landmark[order]
        bounds = np.flatnonzero(np.diff(landmark, prepend=-1, append=-1))
        counts = np.diff(bounds)
        seen_twice = counts > 1
        ids = landmark[bounds[:-1][seen_twice]]
        order = order[np.repeat(seen_twice, counts)]
        bounds = np.r_[0, np.cumsum(counts[seen_twice])]
        state, camera = state[order], camera[order]
        rays, readout = np.take(rays, order, axis=0), np.take(readout, order, axis=0)
        firsts = bounds[:-1]
        frames = (poses[:, None] @ cameras.body_T_cam)[state[firsts], camera[firsts]]
        places = np.column_stack([rays[firsts], np.full(len(ids), PRIOR_INVERSE_DEPTH)])
        if len(self._ids):
            at = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
            known = self._ids[at] == ids
            frames[known], places[known] = self._frames[at[known]], self._places[at[known]]
        self._ids, self._frames, self._places = ids, frames, places
        return Structure(frames, bounds, state, camera, rays, readout), places, ids

    def put(self, ids: Int, frames: Float, places: Float) -> None:
        """Set frames (L, 4, 4) of landmarks (L,) that were collected last, and their coordinates (L, 3) there."""
        rows = np.searchsorted(self._ids, ids)
        self._frames, self._places = self._frames.copy(), self._places.copy()
        self._frames[rows], self._places[rows] = frames, places

    def turn(self, new_T_odom: Float) -> None:
        """Express the landmarks in another frame, given by ``new_T_odom`` (4, 4)."""
        self._frames = new_T_odom @ self._frames


def far_off(structure: Structure, errors2: Float, max_error2: float, max_share: float) -> Bool:
    """Return which landmarks (L,) have too large a share of views whose squared whitened error exceeds a bound."""
    if not len(structure.odom_T_landmark):
        return np.zeros(0, dtype=bool)
    off = np.add.reduceat(errors2 > max_error2, structure.rows[:-1], dtype=np.int64)
    return np.asarray(off > max_share * np.diff(structure.rows))

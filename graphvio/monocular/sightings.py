"""What single cameras saw at the states of a window, and the landmarks that these sightings are joined to.

A track is used as a chain of landmarks, each seen from a limited number of keyframes. When the oldest keyframe leaves
the window, the landmarks that it sees have all their views there, and are eliminated with it: each view counts once.
Lengths differ from track to track, so that at any time only few tracks begin a landmark.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.measurements.motion import Sighting
from graphvio.monocular.structure import PRIOR_INVERSE_DEPTH, Cameras, Structure

_MIX = 2654435761  # of Knuth's multiplicative hash: lengths do not depend on the order of tracks


class Views(NamedTuple):
    """Sightings of one state, joined to landmarks: M of all cameras.

    Attributes:
        camera: (M,) index of the camera that sees them.
        owner: (M,) index of the camera whose track it is.
        ids: (M,) identities of its tracks.
        landmark: (M,) identities of the landmarks.
        rays: (M, 2) normalised coordinates.
    """

    camera: Int
    owner: Int
    ids: Int
    landmark: Int
    rays: Float

    def of(self, landmarks: Int) -> Views:
        """Return the views of some landmarks."""
        return self._rows(np.isin(self.landmark, landmarks))

    def without(self, landmarks: Int) -> Views:
        """Return the views of all but some landmarks."""
        return self._rows(~np.isin(self.landmark, landmarks))

    def _rows(self, kept: Bool) -> Views:
        return Views(self.camera[kept], self.owner[kept], self.ids[kept], self.landmark[kept], self.rays[kept])


class LandmarkNames:
    """Joins tracks to landmarks.

    Args:
        n_cameras: of the rig.
        max_keyframes: that see one landmark.
    """

    def __init__(self, n_cameras: int, max_keyframes: int) -> None:
        self._max_keyframes = max_keyframes
        self._ids: list[Int] = [np.zeros(0, dtype=np.int64) for _ in range(n_cameras)]
        self._landmarks: list[Int] = [np.zeros(0, dtype=np.int64) for _ in range(n_cameras)]
        self._left: list[Int] = [np.zeros(0, dtype=np.int64) for _ in range(n_cameras)]  # keyframes
        self._next = 0

    def join(self, sightings: Mapping[int, Sighting]) -> Views:
        """Join the sightings of an instant to landmarks; tracks that have none begin one."""
        parts = []
        for j, sighting in sorted(sightings.items()):
            ids, n = sighting.ids, len(sighting.ids)
            landmarks, left = np.full(n, -1, dtype=np.int64), np.zeros(n, dtype=np.int64)
            if len(self._ids[j]):
                rows = np.minimum(np.searchsorted(self._ids[j], ids), len(self._ids[j]) - 1)
                known = (self._ids[j][rows] == ids) & (self._left[j][rows] > 0)
                landmarks[known], left[known] = self._landmarks[j][rows[known]], self._left[j][rows[known]]
            new = np.flatnonzero(landmarks < 0)
            landmarks[new] = self._next + np.arange(len(new))
            self._next += len(new)
            shortest = (self._max_keyframes + 1) // 2
            mixed = (ids[new] * _MIX + landmarks[new] * 40503) % 2**32 >> 16
            left[new] = shortest + mixed % (self._max_keyframes - shortest + 1)
            self._ids[j], self._landmarks[j], self._left[j] = ids, landmarks, left
            own = np.full(n, j, dtype=np.int64)
            parts.append(Views(own, own, ids, landmarks, sighting.rays))
            for seen in sighting.elsewhere:
                other = np.full(len(seen.rows), seen.camera, dtype=np.int64)
                parts.append(Views(other, own[seen.rows], ids[seen.rows], landmarks[seen.rows], seen.rays))
        return Views(*(np.concatenate(each) for each in zip(*parts, strict=True))) if parts else _NO_VIEWS

    def note_keyframe(self) -> None:
        """Take note that the newest sightings are those of a keyframe."""
        self._left = [left - 1 for left in self._left]

    def end(self, landmarks: Int) -> None:
        """End some landmarks: tracks that go on begin others."""
        for j, of_camera in enumerate(self._landmarks):
            self._left[j] = np.where(np.isin(of_camera, landmarks), 0, self._left[j])


class Landmarks:
    """Where landmarks are, by their identities."""

    def __init__(self) -> None:
        self._ids: Int = np.zeros(0, dtype=np.int64)
        self._places = np.zeros((0, 3))
        self._frames = np.zeros((0, 4, 4))

    def structure(self, views: Sequence[Views], poses: Float, cameras: Cameras) -> tuple[Structure, Float, Int]:
        """Collect the landmarks that have two views at least, from two states or in two cameras.

        Args:
            views: of the K states, in time order.
            poses: (K, 4, 4) ``odom_T_body``.
            cameras: of the rig.

        Returns:
            The structure, the landmarks (L, 3), and their identities (L,).
        """
        landmark = np.concatenate([each.landmark for each in views])
        state = np.concatenate([np.full(len(each.landmark), k) for k, each in enumerate(views)])
        camera = np.concatenate([each.camera for each in views])
        rays = np.concatenate([each.rays for each in views])
        order = np.lexsort((camera, state, landmark))
        landmark, state, camera, rays = landmark[order], state[order], camera[order], rays[order]
        ids, firsts, counts = np.unique(landmark, return_index=True, return_counts=True)
        seen_twice = counts > 1
        rows = np.repeat(seen_twice, counts)
        ids, firsts = ids[seen_twice], firsts[seen_twice]
        frames = poses[state[firsts]] @ cameras.body_T_cam[camera[firsts]]
        places = np.column_stack([rays[firsts], np.full(len(ids), PRIOR_INVERSE_DEPTH)])
        if len(self._ids):
            at = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
            known = self._ids[at] == ids
            frames[known], places[known] = self._frames[at[known]], self._places[at[known]]
        self._ids, self._frames, self._places = ids, frames, places
        bounds = np.r_[0, np.cumsum(counts[seen_twice])]
        structure = Structure(frames, bounds, state[rows], camera[rows], np.ascontiguousarray(rays[rows]))
        return structure, places, ids

    def put(self, places: Float) -> None:
        """Take new places (L, 3) of the landmarks that were last collected."""
        self._places = places

    def turn(self, new_T_odom: Float) -> None:
        """Express the landmarks in another frame."""
        self._frames = new_T_odom @ self._frames


def far_off(structure: Structure, errors2: Float, max_error2: float, max_share: float) -> Bool:
    """Find the landmarks (L,) of which too large a share of the views has a squared whitened error beyond a bound."""
    if not len(structure.odom_T_landmark):
        return np.zeros(0, dtype=bool)
    off = np.add.reduceat(errors2 > max_error2, structure.rows[:-1], dtype=np.int64)
    return np.asarray(off > max_share * np.diff(structure.rows))


_NONE = np.zeros(0, dtype=np.int64)
_NO_VIEWS = Views(_NONE, _NONE, _NONE, _NONE, np.zeros((0, 2)))

"""Handover of tracks between single cameras: a point that leaves one camera's view is followed in another's.

A camera adopts a point at the place where another camera's track was found in its image, if it has no track of its own
there. Its new track follows the same point, and goes on when the other camera's track ends.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.measurements.motion import HandedOverTracks


class Leaving(NamedTuple):
    """Tracks that are about to leave a camera's view.

    Attributes:
        ids: (N,) identities, increasing.
        inverse_depths: (N,) computed from the camera's own motion, 1/m.
        sigmas: (N,) standard deviations of the inverse depths, 1/m.
    """

    ids: Int
    inverse_depths: Float
    sigmas: Float


@dataclass(frozen=True, eq=False)
class FoundThere:
    """Tracks of one camera that were found in another camera's image.

    Attributes:
        camera: index of the camera that has the tracks.
        ids: (N,) identities of the tracks, increasing.
        pixels: (N, 2) where they were found in the other camera's image.
        inverse_depths: (N,) in the other camera's frame, 1/m.
    """

    camera: int
    ids: Int
    pixels: Float
    inverse_depths: Float


class Handover:
    """Records which camera's track each adopted point comes from.

    Args:
        n_cameras: number of cameras of the rig.
    """

    def __init__(self, n_cameras: int) -> None:
        none = np.zeros(0, dtype=np.int64)
        self._handed_over = [HandedOverTracks(none, none, none) for _ in range(n_cameras)]  # here `rows` are ids

    def handed_over(self, camera: int, frame: TrackedFrame) -> HandedOverTracks:
        """Return the tracks of a frame that follow points of other cameras' tracks."""
        known = self._handed_over[camera]
        at = np.minimum(np.searchsorted(frame.ids, known.rows), max(len(frame.ids) - 1, 0))
        stays = frame.ids[at] == known.rows if len(frame.ids) else np.zeros(len(at), dtype=bool)
        self._handed_over[camera] = known = HandedOverTracks(*(column[stays] for column in known))
        return known._replace(rows=at[stays])

    def is_followed(self, camera: int, frames: Mapping[int, TrackedFrame]) -> Bool:
        """Select the tracks (N,) of a camera whose point is still followed by the camera that it comes from."""
        rows, cameras, ids = self.handed_over(camera, frames[camera])
        followed = np.zeros(len(frames[camera].ids), dtype=bool)
        for k in np.unique(cameras):
            if int(k) in frames:
                of_camera = cameras == k
                followed[rows[of_camera]] = np.isin(ids[of_camera], frames[int(k)].ids)
        return followed

    def adopt(
        self, camera: int, tracker: GroupTracker, frames: Mapping[int, TrackedFrame], found: Iterable[FoundThere]
    ) -> TrackedFrame:
        """Let a camera's tracker follow points of other cameras' tracks in its image, where it has no track.

        Args:
            camera: index of the camera.
            tracker: the tracker of this camera.
            frames: camera index -> tracks, of all cameras.
            found: other cameras' tracks that were found in the image of this camera.

        Returns:
            The camera's tracks, with the adopted points.
        """
        own = self.handed_over(camera, frames[camera])
        followed = set(zip(own.cameras.tolist(), own.ids.tolist(), strict=True))
        followed |= {(camera, int(i)) for i in frames[camera].ids}
        pixels, inverse_depths, origins = [], [], []
        for each in found:
            theirs, their_ids = self.handed_over(each.camera, frames[each.camera]), frames[each.camera].ids
            begun_by = zip(theirs.cameras.tolist(), theirs.ids.tolist(), strict=True)
            begun = dict(zip(their_ids[theirs.rows].tolist(), begun_by, strict=True))
            for i, track in enumerate(each.ids.tolist()):
                origin = begun.get(track, (each.camera, track))
                if origin not in followed:
                    followed.add(origin)
                    origins.append(origin)
                    pixels.append(each.pixels[i])
                    inverse_depths.append(each.inverse_depths[i])
        if not origins:
            return frames[camera]
        frame, rows = tracker.adopt(np.array(pixels), np.array(inverse_depths))
        by, ids = np.array(origins, dtype=np.int64)[rows].T
        new = HandedOverTracks(frame.ids[len(frame.ids) - len(rows) :], by, ids)
        both = zip(self._handed_over[camera], new, strict=True)
        self._handed_over[camera] = HandedOverTracks(*(np.concatenate(columns) for columns in both))
        return frame

"""Correspondences of all pairs between two framesets, from which the relative motion is estimated.

All pairs are expressed in one frame, body: a motion hypothesis is ``cur_T_ref``, which maps points of the rig's body
frame from the reference instant to the current one. Pair j's own motion, the paper's ``P_j``, is
``left_T_body cur_T_ref body_T_left``: the transfer between pairs, eq. (1), is thereby part of every evaluation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows
from graphvio.kernels import kernel, put
from graphvio.rig import Rig

_MAX_RELATIVE_DEPTH_SIGMA = 0.1


class RigArrays(NamedTuple):
    """Calibration of a rig of P groups of cameras, as arrays for kernels; side 0 is left, 1 right.

    A single camera is stored as a pair whose right camera, which never sees a point, is the left one again.

    Attributes:
        cam_T_body: (P, 2, 4, 4) transforms from body to each camera.
        body_T_left: (P, 4, 4) pose in body of the left camera that saw the points at the reference; in a rig made by
            `crossed`, this is the camera of another pair.
        focal_px: (P, 2) focal lengths, pixels per normalised image unit.
    """

    cam_T_body: Float
    body_T_left: Float
    focal_px: Float

    @staticmethod
    def of(rig: Rig) -> RigArrays:
        """Collect the arrays of a rig."""
        # A single camera is stored with its own pose as the right one, see the class.
        return RigArrays(
            np.array([[group.cameras[0].cam_T_body, group.cameras[-1].cam_T_body] for group in rig.groups]),
            np.array([group.left.body_T_cam for group in rig.groups]),
            np.array([[group.cameras[0].focal_px, group.cameras[-1].focal_px] for group in rig.groups]),
        )

    @property
    def is_single(self) -> Bool:
        """(P,) which groups are single cameras."""
        return np.asarray((self.cam_T_body[:, 0] == self.cam_T_body[:, 1]).all(axis=(1, 2)))

    def crossed(self, pairs: Sequence[tuple[int, int]]) -> RigArrays:
        """Build a virtual rig with one pair for each of K tuples (a, b) of pair indices.

        The points of its pair k are given in the left camera of pair a at the reference, and are seen now by the
        cameras of pair b.
        """
        of, by = [a for a, _ in pairs], [b for _, b in pairs]
        return RigArrays(self.cam_T_body[by], self.body_T_left[of], self.focal_px[by])

    def corrected(self, nominal: RigArrays, pair: int, correction: Float) -> RigArrays:
        """Return the rig with one pair moved: its ``body_T_left`` is ``correction`` (4, 4) times the nominal one."""
        cam_T_body, body_T_left = self.cam_T_body.copy(), self.body_T_left.copy()
        body_T_left[pair] = correction @ nominal.body_T_left[pair]
        cam_T_body[pair] = nominal.cam_T_body[pair] @ np.linalg.inv(correction)
        return RigArrays(cam_T_body, body_T_left, self.focal_px)


class Observations(NamedTuple):
    """N points known at the reference instant and seen at the current one, sorted by pair.

    Attributes:
        pair: (N,) index of the pair.
        points: (N, 3) ``[x, y, 1/Z]`` in the pair's left camera at the reference instant.
        covariances: (N, 3, 3) of ``points``, for a pixel noise of 1 px.
        left: (N, 2) normalised coordinates in the current left image.
        right: (N, 2) the same in the current right image; zero where it is not ``has_right``.
        has_right: (N,) whether the current right image sees the point.
    """

    pair: Int
    points: Float
    covariances: Float
    left: Float
    right: Float
    has_right: Bool

    @property
    def pairs(self) -> tuple[int, ...]:
        """Pairs that have points, in order."""
        return tuple(int(j) for j in np.flatnonzero(np.bincount(self.pair)))

    def has_known_depth(self, sigma_px: float) -> Bool:
        """Select the points (N,) whose inverse depth is known to a tenth, for a pixel noise in pixels."""
        return np.asarray(sigma_px * np.sqrt(self.covariances[:, 2, 2]) < _MAX_RELATIVE_DEPTH_SIGMA * self.points[:, 2])

    def of_pair(self, pair: int) -> Observations:
        """Return one pair's points, not copied."""
        return self.of_rows(slice(*np.searchsorted(self.pair, [pair, pair + 1])))

    def of_rows(self, rows: Bool | slice) -> Observations:
        """Return some of the points: by a mask (N,), or a range."""
        return Observations(
            self.pair[rows], self.points[rows], self.covariances[rows], self.left[rows], self.right[rows],
            self.has_right[rows],
        )  # fmt: skip


def is_depth_known(rig: RigArrays, observations: Observations, sigma_px: float) -> Bool:
    """Select the points (N,) that a motion can be tested on: not those of single cameras with hardly known depth."""
    is_single = rig.is_single
    if not is_single.any():
        return np.ones(len(observations.pair), dtype=bool)
    return np.asarray(~is_single[observations.pair] | observations.has_known_depth(sigma_px))


def image_by_image(rig: RigArrays, observations: Observations) -> tuple[RigArrays, Observations, Int]:
    """Split observations into those of single images, with exact points, as eq. (2) has them.

    Each image becomes a pair of its own without a right camera, and the points' covariances become zero. The error that
    kernels compute for a point is then a vector of two, in one image, with only the noise of its pixels, as in eq. (2).

    Args:
        rig: calibration of P pairs.
        observations: N points of any subset of them.

    Returns:
        The rig as 2P pairs, each pair's left camera before its right one; the M observations in single images; and for
        each of them its row (M,) in the given observations.
    """
    images = RigArrays(
        np.repeat(rig.cam_T_body.reshape(-1, 1, 4, 4), 2, axis=1),
        np.repeat(rig.body_T_left, 2, axis=0),
        np.repeat(rig.focal_px.reshape(-1, 1), 2, axis=1),
    )
    n = len(observations.pair)
    rows = np.concatenate([np.arange(n), np.flatnonzero(observations.has_right)])
    is_right = np.arange(len(rows)) >= n
    image = 2 * observations.pair[rows] + is_right
    places = np.concatenate([observations.left, observations.right[observations.has_right]])
    order = np.argsort(image, kind="stable")
    rows, none = rows[order], np.zeros((len(rows), 2))
    exact, alone = np.zeros((len(rows), 3, 3)), np.zeros(len(rows), dtype=bool)
    return images, Observations(image[order], observations.points[rows], exact, places[order], none, alone), rows


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Observations, and the tracks that they came from.

    Attributes:
        observations: the points of all pairs.
        rows: pair -> (M,) rows of the current `TrackedFrame` that take part, in order.
        candidates: pair -> number of points with depth at its reference, for the pairs that take part.
        singles: which of these pairs are single cameras.
    """

    observations: Observations
    rows: Mapping[int, Int]
    candidates: Mapping[int, int]
    singles: frozenset[int] = frozenset()

    def identities(self, frames: Mapping[int, TrackedFrame], inlier: Bool) -> dict[int, Int]:
        """Return pair -> identities, increasing, of its current tracks that are inliers among all points (N,)."""
        return {j: frames[j].ids[rows[inlier[self.observations.pair == j]]] for j, rows in self.rows.items()}


def correspond(reference: Mapping[int, TrackedFrame], current: Mapping[int, TrackedFrame]) -> Correspondences:
    """Join the tracks of two instants by their identities; points without depth at the reference stay out."""
    rows: dict[int, Int] = {}
    candidates: dict[int, int] = {}
    parts: list[Observations] = []
    for pair in sorted(reference.keys() & current.keys()):
        then, now = reference[pair], current[pair]
        candidates[pair] = int(np.count_nonzero(then.has_depth))
        joined, rows[pair] = _join(
            pair, then.ids, then.has_depth, then.points, then.covariances,
            now.ids, now.has_right, now.left_rays, now.right_rays,
        )  # fmt: skip
        parts.append(joined)
    if not parts:
        return Correspondences(_NOTHING, rows, candidates)
    singles = frozenset(j for j in rows if current[j].is_single)
    return Correspondences(
        Observations(*(np.concatenate(c) for c in zip(*parts, strict=True))), rows, candidates, singles
    )


@kernel
def _join(
    pair: int, ids_then: Int, known: Bool, points: Float, covariances: Float,
    ids_now: Int, has_right: Bool, left: Float, right: Float,
) -> tuple[Observations, Int]:  # fmt: skip
    """Join one pair's tracks whose depth is known at the reference: observations, and their rows (M,) now."""
    at_then, at_now = common_rows(ids_then, ids_now)
    of_known = known[at_then]
    at_then, at_now = at_then[of_known], at_now[of_known]
    n = len(at_now)
    in_right, seen = np.zeros((n, 2)), has_right[at_now]
    for i in range(n):
        if seen[i]:
            put(in_right[i], right[at_now[i]])
    return Observations(
        np.full(n, pair, dtype=np.int64), points[at_then], covariances[at_then], left[at_now], in_right, seen
    ), at_now


_NOTHING = Observations(
    np.zeros(0, dtype=np.int64),
    np.zeros((0, 3)),
    np.zeros((0, 3, 3)),
    np.zeros((0, 2)),
    np.zeros((0, 2)),
    np.zeros(0, dtype=bool),
)

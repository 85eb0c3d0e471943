"""Depth of a single camera's points by triangulation over its motion.

At each keyframe after the one at which a track began, its inverse depth is the least-squares solution for the rays of
its first sight and of the newest one, given the motion that all cameras measured in between. Before there is any
baseline, the depth has a wide prior: such a point constrains the motion by its epipolar line only, as its covariance
expresses.

The motion's error is common to all points, which a separate covariance for each point cannot express: where a motion is
estimated by these points, an unknown common scale stands for it, see `graphvio.frontend.motion.depth_scale`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.frontend.depth.tracks import common_rows
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.kernels import kernel
from graphvio.rig import Camera

PRIOR_INVERSE_DEPTH = 0.2
_PRIOR_SIGMA = 10.0  # 1/m: next to nothing is known
_DRIFT_PX2 = 1.0  # variance that a track's place gains from keyframe to keyframe, for a pixel noise of 1 px
_MAX_KEYFRAMES = 40
_STEPS = 5
_MIN_DEPTH_RATIO = 1e-3
_MAX_DISTANCE = 25.0  # squared, in standard deviations: beyond, the point moves, or is another one


class Since(NamedTuple):
    """Motion from an earlier keyframe to the newest one.

    Attributes:
        cur_T_then: (4, 4) motion of body.
        covariance: (6, 6), tangent ``[rotation, translation]``, perturbation on the left, in body now.
        keyframes: number of keyframes from that one to the newest one.
    """

    cur_T_then: Float
    covariance: Float
    keyframes: int


class MotionHistory:
    """Motions of the rig from its latest keyframes to the newest one."""

    def __init__(self) -> None:
        self._since: dict[int, Since] = {}
        self.newest_ns: int | None = None

    def advance(self, then_ns: int, now_ns: int, cur_T_then: Float, covariance: Float) -> None:
        """Add a keyframe at ``now_ns``, with the motion (4, 4) since another one and its covariance (6, 6)."""
        if then_ns != self.newest_ns:
            self.restart(then_ns)
        adjoint = se3_adjoint(np.ascontiguousarray(cur_T_then))
        since = {
            ns: Since(
                cur_T_then @ each.cur_T_then, adjoint @ each.covariance @ adjoint.T + covariance, each.keyframes + 1
            )
            for ns, each in list(self._since.items())[-_MAX_KEYFRAMES:]
        }
        self.restart(now_ns)
        self._since = since | self._since

    def recalibrate(self, new_T_old: Float) -> None:
        """Change the body frame by a transform (4, 4): the cameras' motions stay the same, those of body change."""
        old_T_new, adjoint = se3_inverse(new_T_old), se3_adjoint(np.ascontiguousarray(new_T_old))
        self._since = {
            ns: Since(new_T_old @ each.cur_T_then @ old_T_new, adjoint @ each.covariance @ adjoint.T, each.keyframes)
            for ns, each in self._since.items()
        }

    def restart(self, now_ns: int) -> None:
        """Begin again with a keyframe whose motion since the earlier ones is not known."""
        self._since = {now_ns: Since(np.eye(4), np.zeros((6, 6)), 0)}
        self.newest_ns = now_ns

    def since(self, then_ns: int) -> Since | None:
        """Return the motion since a keyframe, or None if it is not known."""
        return self._since.get(then_ns)


class FirstSights:
    """First sights of one camera's tracks: their rays at the keyframes from which their depths are triangulated.

    Where a rolling shutter is compensated, a ray at the stamp is a linear function of the inverse depth.
    """

    def __init__(self) -> None:
        self._ids: Int = np.zeros(0, dtype=np.int64)
        self._stamps_ns: Int = np.zeros(0, dtype=np.int64)
        self._rays: Float = np.zeros((0, 2))
        self._slopes: Float = np.zeros((0, 2))

    def recalibrate(self, then: Camera, now: Camera) -> None:
        """Use another calibration of the camera, by which the same pixels have other normalised coordinates."""
        pixels, is_seen = then.project(np.column_stack([self._rays, np.ones(len(self._rays))]))
        rays, has_ray = now.unproject(pixels)
        self._rays = np.where((is_seen & has_ray)[:, None], rays, self._rays)

    def see_again(self, stamp_ns: int, ids: Int, rays: Float, slopes: Float) -> None:
        """Replace rays and slopes (N, 2) of first sights at a keyframe, whose rolling shutter was compensated again.

        Args:
            stamp_ns: stamp of the keyframe.
            ids: (N,) identities of its tracks, increasing.
            rays: (N, 2) normalised coordinates of points at infinity.
            slopes: (N, 2) derivatives of these with respect to the inverse depth.
        """
        own, rows = common_rows(self._ids, ids)
        is_then = self._stamps_ns[own] == stamp_ns
        self._rays[own[is_then]], self._slopes[own[is_then]] = rays[rows[is_then]], slopes[rows[is_then]]

    def locate(
        self,
        ids: Int,
        rays: Float,
        history: MotionHistory,
        body_T_cam: Float,
        focal_px: float,
        sigma_px: float,
        slopes: Float | None = None,
    ) -> tuple[Float, Float]:
        """Compute the points of a keyframe's tracks; for tracks without a first sight, this is the first one.

        Args:
            ids: (N,) identities of the tracks, increasing.
            rays: (N, 2) their normalised coordinates, with a rolling shutter those of points at infinity.
            history: motion history with this keyframe as the newest one.
            body_T_cam: (4, 4) pose of the camera.
            focal_px: focal length, pixels per normalised image unit.
            sigma_px: pixel noise.
            slopes: (N, 2) derivatives of the rays with respect to the inverse depth, with a rolling shutter; None for
                zero.

        Returns:
            Points (N, 3) ``[x, y, 1/Z]`` and their covariances (N, 3, 3) for a pixel noise of 1 px, in the form of
            `graphvio.frontend.depth.stereo.triangulate`.
        """
        assert history.newest_ns is not None
        slopes = np.zeros_like(rays) if slopes is None else slopes
        stamps_ns, first, first_slopes = self._of_tracks(ids, rays, slopes, history)
        instants, which = np.unique(stamps_ns, return_inverse=True)
        cam_T_body, since = se3_inverse(body_T_cam), [history.since(int(ns)) for ns in instants]
        adjoint = se3_adjoint(cam_T_body)
        known = [each for each in since if each is not None]  # all of them, by `_of_tracks`
        then_T_now = np.array([cam_T_body @ se3_inverse(each.cur_T_then) @ body_T_cam for each in known])
        motion = np.array([adjoint @ each.covariance @ adjoint.T for each in known]) / sigma_px**2
        drift = np.array([_DRIFT_PX2 * each.keyframes for each in known])
        points, covariances, fits = _locate(
            rays, slopes, first, first_slopes, which, then_T_now.reshape(-1, 4, 4), motion.reshape(-1, 6, 6), drift,
            1.0 / focal_px**2, (_PRIOR_SIGMA / sigma_px) ** 2, _MAX_DISTANCE * sigma_px**2,
        )  # fmt: skip
        self._ids, self._rays = ids, np.where(fits[:, None], first, rays)
        self._slopes = np.where(fits[:, None], first_slopes, slopes)
        self._stamps_ns = np.where(fits, stamps_ns, history.newest_ns)
        return points, covariances

    def _of_tracks(self, ids: Int, rays: Float, slopes: Float, history: MotionHistory) -> tuple[Int, Float, Float]:
        """Return stamps (N,), rays and slopes (N, 2) of the tracks' first sights: this keyframe's if there is none."""
        stamps_ns = np.full(len(ids), history.newest_ns, dtype=np.int64)
        first, first_slopes = rays.copy(), slopes.copy()
        if len(self._ids):
            rows = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
            reached = {int(ns): history.since(int(ns)) is not None for ns in np.unique(self._stamps_ns)}
            is_known = np.array([reached[int(ns)] for ns in self._stamps_ns[rows]], dtype=bool)
            has = (self._ids[rows] == ids) & is_known
            stamps_ns[has], first[has] = self._stamps_ns[rows[has]], self._rays[rows[has]]
            first_slopes[has] = self._slopes[rows[has]]
        return stamps_ns, first, first_slopes


@kernel
def _locate(
    rays: Float, slopes: Float, first: Float, first_slopes: Float, which: Int, then_T_now: Float, motion: Float,
    drift: Float, pixel: float, prior: float, max_distance: float,
) -> tuple[Float, Float, Bool]:  # fmt: skip
    """Compute points (N, 3), covariances (N, 3, 3), and which of them (N,) fit the motion; the others have the prior.

    Args:
        rays: (N, 2) normalised coordinates now, of points at infinity.
        slopes: (N, 2) derivatives of these with respect to the inverse depth.
        first: (N, 2) normalised coordinates at the tracks' first sights, of points at infinity.
        first_slopes: (N, 2) derivatives of these with respect to the inverse depth then.
        which: (N,) index of the instant of each track's first sight, among A instants.
        then_T_now: (A, 4, 4) pose of the camera now, in the camera's frame at each instant.
        motion: (A, 6, 6) covariance of the motion since then, in the camera's frame now, for a pixel noise of 1 px.
        drift: (A,) variance of the track's place, pixels squared.
        pixel: variance of a pixel in normalised coordinates.
        prior: variance of the inverse depth, for a pixel noise of 1 px.
        max_distance: largest squared whitened error.
    """
    n = len(rays)
    points, covariances, fits = np.empty((n, 3)), np.zeros((n, 3, 3)), np.ones(n, dtype=np.bool_)
    by_ray, by_motion = np.empty((2, 2)), np.empty((2, 6))
    for i in range(n):
        m, c = then_T_now[which[i]], motion[which[i]]
        w = PRIOR_INVERSE_DEPTH
        x, y = rays[i, 0] + w * slopes[i, 0], rays[i, 1] + w * slopes[i, 1]
        variance, gain_x, gain_y, e2 = prior, 0.0, 0.0, 0.0
        for _ in range(_STEPS):
            z = max(m[2, 0] * x + m[2, 1] * y + m[2, 2] + w * m[2, 3], _MIN_DEPTH_RATIO)
            u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] + w * m[0, 3]) / z
            v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] + w * m[1, 3]) / z
            for k in range(3):
                a, b = (m[0, k] - u * m[2, k]) / z, (m[1, k] - v * m[2, k]) / z
                if k < 2:
                    by_ray[0, k], by_ray[1, k] = a, b
                by_motion[0, 3 + k], by_motion[1, 3 + k] = -w * a, -w * b
            # The rotation moves the point p = (x, y, 1) by its cross product with p.
            for r in range(2):
                g0, g1 = by_ray[r, 0], by_ray[r, 1]
                g2 = (m[r, 2] - (u if r == 0 else v) * m[2, 2]) / z
                by_motion[r, 0] = g1 - g2 * y
                by_motion[r, 1] = g2 * x - g0
                by_motion[r, 2] = g0 * y - g1 * x
            # Of the predicted ray less the one that was seen, which both depend on the inverse depth.
            then = (1.0 - w / z * (m[2, 3] + m[2, 0] * slopes[i, 0] + m[2, 1] * slopes[i, 1])) / z
            j0 = (m[0, 3] - u * m[2, 3]) / z
            j0 += by_ray[0, 0] * slopes[i, 0] + by_ray[0, 1] * slopes[i, 1] - then * first_slopes[i, 0]
            j1 = (m[1, 3] - v * m[2, 3]) / z
            j1 += by_ray[1, 0] * slopes[i, 0] + by_ray[1, 1] * slopes[i, 1] - then * first_slopes[i, 1]
            own = pixel * (1.0 + drift[which[i]])
            s00 = own + pixel * (by_ray[0, 0] ** 2 + by_ray[0, 1] ** 2)
            s11 = own + pixel * (by_ray[1, 0] ** 2 + by_ray[1, 1] ** 2)
            s01 = pixel * (by_ray[0, 0] * by_ray[1, 0] + by_ray[0, 1] * by_ray[1, 1])
            for p in range(6):
                for q in range(6):
                    s00 += by_motion[0, p] * c[p, q] * by_motion[0, q]
                    s01 += by_motion[0, p] * c[p, q] * by_motion[1, q]
                    s11 += by_motion[1, p] * c[p, q] * by_motion[1, q]
            det = s00 * s11 - s01 * s01
            r0, r1 = first[i, 0] + w / z * first_slopes[i, 0] - u, first[i, 1] + w / z * first_slopes[i, 1] - v
            # J^T S^-1
            k0, k1 = (j0 * s11 - j1 * s01) / det, (j1 * s00 - j0 * s01) / det
            variance = 1.0 / (k0 * j0 + k1 * j1 + 1.0 / prior)
            gain_x = -variance * (k0 * by_ray[0, 0] + k1 * by_ray[1, 0])
            gain_y = -variance * (k0 * by_ray[0, 1] + k1 * by_ray[1, 1])
            e2 = (s11 * r0 * r0 - 2.0 * s01 * r0 * r1 + s00 * r1 * r1) / det
            w += variance * (k0 * r0 + k1 * r1 + (PRIOR_INVERSE_DEPTH - w) / prior)
            x, y = rays[i, 0] + w * slopes[i, 0], rays[i, 1] + w * slopes[i, 1]
        # Where the motion is hardly known, rounding may make S indefinite, and variances negative.
        if not (0.0 <= e2 < max_distance and w >= -3.0 * np.sqrt(variance)):
            fits[i], w, variance, gain_x, gain_y = False, PRIOR_INVERSE_DEPTH, prior, 0.0, 0.0
            x, y = rays[i, 0] + w * slopes[i, 0], rays[i, 1] + w * slopes[i, 1]
        points[i, 0], points[i, 1], points[i, 2] = x, y, w
        covariances[i, 0, 0] = covariances[i, 1, 1] = pixel
        covariances[i, 0, 2] = covariances[i, 2, 0] = pixel * gain_x
        covariances[i, 1, 2] = covariances[i, 2, 1] = pixel * gain_y
        covariances[i, 2, 2] = variance
    return points, covariances, fits

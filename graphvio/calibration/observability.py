"""Observability of the relative pose of two cameras from the motions of a recording.

Rotation about one axis only leaves the offset of the cameras along it undetermined; without rotation, the whole offset
is undetermined. The noise of the motions looks like a little rotation about every axis, and so like information:
information that is not well above that of the noise does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from graphvio.arrays import Float
from graphvio.calibration.consistency import information
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.geometry import se3_adjoint, se3_inverse, skew
from graphvio.kernels import kernel

_MIN_LEAD = 4.0  # ratio of information to that of noise alone
_FLOOR = 1e-9  # lower bound for the noise's information relative to all of it, for a stable division
_UNKNOWN_SIGMAS = np.repeat([np.pi, 5.0], 3)  # radians and metres, of undetermined directions
_ALONG = 0.9  # cosine from which an axis is named after the camera's own
_AXES = ("x (right)", "y (down)", "z (forward)")


@dataclass(frozen=True, eq=False)
class Observability:
    """The directions of a relative pose that motions determine, and those that they do not."""

    # (3,) of the problem of the translation, eq. (6), as rms rotation, rad, in descending order; two of them must be
    # well above the noise
    translation_singular_values: Float
    # (3,) rms rotation about principal axes, singular values of the problem of the rotation, eq. (5)
    turning_rad: Float
    undetermined: Float  # (K, 6) orthonormal directions, tangent in left1, that the motions do not determine
    covariance: Float  # (6, 6) of ``left2_T_left1``, tangent in left1; very large along undetermined directions
    # a sentence on each undetermined part and what to do about it; empty if everything is determined
    missing: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Whether the motions determine all of the relative pose."""
        return not len(self.undetermined)


def observe(pairs: PosePairs, left2_T_left1: Float) -> Observability:
    """Find the directions of ``left2_T_left1`` that pose pairs determine, at a solution (4, 4)."""
    motions = pairs.motion_1, pairs.covariance_1, pairs.covariance_2
    known, by_noise = information(pairs, left2_T_left1), _noise_information(left2_T_left1, *motions)
    scale = np.diag(_UNKNOWN_SIGMAS)  # so that radians and metres compare
    known, by_noise = scale @ known @ scale, scale @ by_noise @ scale
    floor = _FLOOR * np.trace(known) + 1.0  # 1: a priori
    leads, directions = eigh(known, by_noise + floor * np.eye(6))
    weak = directions[:, leads < _MIN_LEAD]
    undetermined = np.linalg.qr(scale @ weak)[0].T if weak.size else np.zeros((0, 6))
    # Invert the information on the determined directions alone; the others keep their a-priori variance.
    basis = np.linalg.qr(np.hstack([weak, np.eye(6)]))[0]
    across, along = basis[:, : weak.shape[1]], basis[:, weak.shape[1] :]
    covariance = along @ np.linalg.inv(along.T @ known @ along) @ along.T + across @ across.T
    turning, axes = np.linalg.eigh(pairs.rotations_rad.T @ pairs.rotations_rad / len(pairs))
    turning_rad, axes = np.sqrt(np.maximum(turning[::-1], 0.0)), axes[:, ::-1].T
    lever = np.concatenate([np.eye(3) - motion[:3, :3] for motion in pairs.motion_2])
    return Observability(
        translation_singular_values=np.linalg.svd(lever / np.sqrt(len(pairs)), compute_uv=False),
        turning_rad=turning_rad,
        undetermined=undetermined,
        covariance=scale @ covariance @ scale,
        missing=tuple(_missing(undetermined, axes, turning_rad)),
    )


@kernel
def _noise_information(left2_T_left1: Float, motion_1: Float, covariance_1: Float, covariance_2: Float) -> Float:
    """Return the expected information (6, 6) that the motions' noise alone appears to give."""
    total = np.zeros((6, 6))
    adjoint = se3_adjoint(left2_T_left1)
    for k in range(len(motion_1)):
        weight = adjoint.T @ np.linalg.inv(covariance_2[k] + adjoint @ covariance_1[k] @ adjoint.T) @ adjoint
        back = se3_adjoint(se3_inverse(motion_1[k]))
        root = np.linalg.cholesky(covariance_1[k])
        for column in range(6):
            change = _small_adjoint(root[:, column].copy()) @ back
            total += change.T @ weight @ change
    return total


@kernel
def _small_adjoint(tangent: Float) -> Float:
    """Return the matrix ad(d) (6, 6), with ``Ad(exp(d)) = 1 + ad(d)`` to first order."""
    small = np.zeros((6, 6))
    turn, shift = skew(tangent[:3]), skew(tangent[3:])
    for i in range(3):
        for j in range(3):
            small[i, j], small[3 + i, 3 + j], small[3 + i, j] = turn[i, j], turn[i, j], shift[i, j]
    return small


def _missing(undetermined: Float, axes: Float, turning_rad: Float) -> list[str]:
    """Return sentences on the undetermined directions, and what to do about them."""
    if not len(undetermined):
        return []
    turns = np.rad2deg(turning_rad)
    rotations, translations = (_directions(undetermined[:, part]) for part in (slice(0, 3), slice(3, 6)))
    if len(rotations) == 3:
        return ["the rig hardly moved: the pose between the cameras cannot be found; walk, and turn it about two axes"]
    sentences = []
    if len(translations) == 3:
        sentences.append(
            f"the rig hardly turned ({turns[0]:.2g} degrees rms in a motion): the offset between the cameras cannot be "
            "found; turn it about two axes"
        )
    elif len(translations):
        along = " and ".join(map(_named, translations))
        sentences.append(
            f"rotation only about the axis {_named(axes[0])} of the first left camera ({turns[0]:.2g} degrees rms, "
            f"{turns[1]:.2g} about others): the offset along {along} cannot be found; tilt the rig while turning"
        )
    if len(rotations):
        about = " and ".join(map(_named, rotations))
        sentences.append(
            f"the angle between the cameras about {about} of the first left camera cannot be found; turn the rig about "
            "another axis, or move it sideways"
        )
    return sentences


def _directions(parts: Float) -> Float:
    """Return an orthonormal basis (K, 3) of the space of vectors (N, 3), without directions of small components."""
    _, sizes, rows = np.linalg.svd(parts)
    return np.asarray(rows[: int(np.sum(sizes > 0.3))])


def _named(axis: Float) -> str:
    """Return the name of an axis: that of the nearest camera axis, or its coordinates."""
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) > _ALONG:
        return _AXES[nearest]
    turned = axis * np.sign(axis[nearest])
    return "[" + ", ".join(f"{value:.2f}" for value in turned) + "]"

"""What the motions of a recording can tell of the relative pose of two cameras, and what they cannot.

Turning about one axis only, nothing tells how far apart the cameras are along it; without any turning, nothing tells
their offset at all. The noise of the motions looks like a little turning about every axis, and so like information:
what is not well above the noise counts as not known.
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

_LEAST_LEAD = 4.0  # information over what noise alone would give
_FLOOR = 1e-9  # of the noise's information over the largest, so that it can be divided by
_UNKNOWN_SIGMAS = np.repeat([np.pi, 5.0], 3)  # radians and metres: of what nothing tells
_ALONG = 0.9  # cosine from which an axis is called by the camera's own
_AXES = ("x (right)", "y (down)", "z (forward)")


@dataclass(frozen=True, eq=False)
class Observability:
    """How well a recording's motions suit the calibration.

    Attributes:
        translation_singular_values: (3,) of the problem of the translation, eq. (6), as rms turning, rad, in descending
            order; two of them must be well above the noise.
        turning_axes: (3, 3) rows: principal axes of the turning, in left1.
        turning_rad: (3,) rms turning about these, the singular values of the problem of the rotation, eq. (5).
        undetermined: (K, 6) orthonormal directions, tangent in left1, of which the motions tell nothing.
        covariance: (6, 6) of ``left2_T_left1``, tangent in left1; very large along what is not determined.
        missing: what is not determined and what to do about it, a sentence each; none where all is.
    """

    translation_singular_values: Float
    turning_axes: Float
    turning_rad: Float
    undetermined: Float
    covariance: Float
    missing: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Whether the motions determine all of the relative pose."""
        return not len(self.undetermined)


def observe(pairs: PosePairs, left2_T_left1: Float) -> Observability:
    """What pose pairs tell, at a solution (4, 4)."""
    told, by_noise = information(pairs, left2_T_left1), _noise_information(pairs, left2_T_left1)
    scale = np.diag(_UNKNOWN_SIGMAS)  # so that radians and metres compare
    told, by_noise = scale @ told @ scale, scale @ by_noise @ scale
    floor = _FLOOR * np.trace(told) + 1.0  # 1: what is known before
    leads, directions = eigh(told, by_noise + floor * np.eye(6))
    weak = directions[:, leads < _LEAST_LEAD]
    undetermined = np.linalg.qr(scale @ weak)[0].T if weak.size else np.zeros((0, 6))
    # Of what is determined, the information without what is not; of the rest, nothing but that it is somewhere.
    basis = np.linalg.qr(np.hstack([weak, np.eye(6)]))[0]
    known = basis[:, weak.shape[1] :]
    covariance = known @ np.linalg.inv(known.T @ told @ known) @ known.T
    covariance = covariance + basis[:, : weak.shape[1]] @ basis[:, : weak.shape[1]].T
    turning, axes = np.linalg.eigh(pairs.rotations_rad.T @ pairs.rotations_rad / len(pairs))
    turning_rad, axes = np.sqrt(np.maximum(turning[::-1], 0.0)), axes[:, ::-1].T
    lever = np.concatenate([np.eye(3) - motion[:3, :3] for motion in pairs.motion_2])
    return Observability(
        translation_singular_values=np.linalg.svd(lever / np.sqrt(len(pairs)), compute_uv=False),
        turning_axes=axes,
        turning_rad=turning_rad,
        undetermined=undetermined,
        covariance=scale @ covariance @ scale,
        missing=tuple(_missing(undetermined, axes, turning_rad)),
    )


def _noise_information(pairs: PosePairs, left2_T_left1: Float) -> Float:
    """What the noise of the motions adds to the information (6, 6), on average."""
    return np.asarray(_added_by_noise(left2_T_left1, pairs.motion_1, pairs.covariance_1, pairs.covariance_2))


@kernel
def _added_by_noise(left2_T_left1: Float, motion_1: Float, covariance_1: Float, covariance_2: Float) -> Float:
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
    """(6, 6) with ``Ad(exp(d)) = 1 + ad(d)`` to first order."""
    small = np.zeros((6, 6))
    turn, shift = skew(tangent[:3]), skew(tangent[3:])
    for i in range(3):
        for j in range(3):
            small[i, j], small[3 + i, 3 + j], small[3 + i, j] = turn[i, j], turn[i, j], shift[i, j]
    return small


def _missing(undetermined: Float, axes: Float, turning_rad: Float) -> list[str]:
    """What is not determined, in words."""
    if not len(undetermined):
        return []
    turns = np.rad2deg(turning_rad)
    rotations, translations = (_directions(undetermined[:, part]) for part in (slice(0, 3), slice(3, 6)))
    if len(rotations) == 3:
        return ["the rig hardly moved: nothing tells how the cameras are placed; walk, and turn it about two axes"]
    told = []
    if len(translations) == 3:
        told.append(
            f"the rig hardly turned ({turns[0]:.2g} degrees rms in a motion): the offset between the cameras cannot be "
            "found; turn it about two axes"
        )
    elif len(translations):
        along = " and ".join(map(_named, translations))
        told.append(
            f"rotation only about the axis {_named(axes[0])} of the first left camera ({turns[0]:.2g} degrees rms, "
            f"{turns[1]:.2g} about others): the offset along {along} cannot be found; tilt the rig while turning"
        )
    if len(rotations):
        about = " and ".join(map(_named, rotations))
        told.append(
            f"the angle between the cameras about {about} of the first left camera cannot be found; turn the rig about "
            "another axis, or move it sideways"
        )
    return told


def _directions(parts: Float) -> Float:
    """An orthonormal basis (K, 3) of what vectors (N, 3) interval, but for what is small."""
    _, sizes, rows = np.linalg.svd(parts)
    return np.asarray(rows[: int(np.sum(sizes > 0.3))])


def _named(axis: Float) -> str:
    """An axis by its name in the camera, or by its numbers."""
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) > _ALONG:
        return _AXES[nearest]
    turned = axis * np.sign(axis[nearest])
    return "[" + ", ".join(f"{value:.2f}" for value in turned) + "]"

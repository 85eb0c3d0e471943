"""Synthetic visual motions, with errors that are sampled from the covariances of the front-end on images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.motions import log_vision
from benchmarks.recordings import simulated

from graphvio.arrays import Float
from graphvio.backend.noise import own_covariance
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import FrameSet
from graphvio.odometry import Odometry
from graphvio.sources import open_source


@dataclass(frozen=True, eq=False)
class Template:
    """The reference and covariance of a motion that the front-end measured.

    Attributes:
        reference: number of the frameset from which the motion is measured.
        covariance: (6, 6) covariance of the motion, a tangent in the body frame at its end.
        shared: (6, 6) part of the covariance that all motions from that frameset have in common.
    """

    reference: int
    covariance: Float
    shared: Float


def templates_of(data: Path, scene: str) -> dict[int, Template]:
    """Return the front-end's motions on a rendered scene, by the number of the frameset."""
    source = open_source(simulated(data, scene))
    odometry = Odometry(source.rig.without_imu())
    vision_log = log_vision(odometry)
    for measurement in source:
        if isinstance(measurement, FrameSet):
            odometry.process(measurement)
    odometry.finish()
    number = {stamp_ns: k for k, stamp_ns in enumerate(sorted(vision_log.results))}
    motions = {stamp_ns: result.motion for stamp_ns, result in vision_log.results.items()}
    return {
        number[stamp_ns]: Template(number[motion.reference_stamp_ns], motion.covariance, motion.shared_covariance)
        for stamp_ns, motion in motions.items()
        if motion is not None
    }


class SyntheticVision:
    """Source of motions with independent errors, and one error for each reference that its motions share.

    Args:
        templates: number of a frameset -> covariances and reference of the motion that ends there.
        nav_T_body: (N, 4, 4) true poses at the framesets.
        stamps_ns: (N,) stamps of the framesets.
        rng: random generator of the errors.
    """

    def __init__(
        self, templates: dict[int, Template], nav_T_body: Float, stamps_ns: list[int], rng: np.random.Generator
    ) -> None:
        self._templates = templates
        self._truth = nav_T_body
        self._stamps_ns = stamps_ns
        self._rng = rng
        self._shared: dict[int, tuple[Float, Float]] = {}  # reference -> shared covariance, and the sampled error

    def reference(self, number: int) -> int | None:
        """Return the number of the frameset from which the motion to a frameset is measured; None without a motion."""
        return self._templates[number].reference if number in self._templates else None

    def at(self, number: int) -> RelativeMotion | None:
        """Return the motion that ends at a frameset, or None if there is none."""
        template = self._templates.get(number)
        if template is None:
            return None
        start = template.reference
        true = np.ascontiguousarray(np.linalg.inv(self._truth[start]) @ self._truth[number])
        if start not in self._shared:
            to_reference = se3_adjoint(true)
            shared = to_reference @ template.shared @ to_reference.T
            self._shared[start] = shared, self._sample(shared)
        shared, shared_error = self._shared[start]
        to_current = se3_adjoint(se3_inverse(true))
        own = own_covariance(template.covariance, to_current @ shared @ to_current.T)
        measured = se3_exp(-shared_error) @ true @ se3_exp(self._sample(own))
        return RelativeMotion(
            self._stamps_ns[start], self._stamps_ns[number], measured, template.covariance, template.shared, 300
        )

    def _sample(self, covariance: Float) -> Float:
        return np.linalg.cholesky(covariance) @ self._rng.standard_normal(6)

"""Poses of the cameras in body as motions are estimated with: the rig's, and what the cameras' own motions correct."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.frontend.alignment import Misalignment, PairAlignment, Place
from graphvio.frontend.observations import RigArrays
from graphvio.frontend.refinement import Refined
from graphvio.geometry import se3_adjoint, se3_inverse, skew
from graphvio.rig import Rig


class Places:
    """Where pairs and single cameras are on the rig, and how well that is known.

    Self-calibration finds errors of the pairs where it is on; then only the places of single cameras are monitored.

    Args:
        rig: Stereo pairs and single cameras.
        config: Configuration of all stages.

    Attributes:
        arrays: The rig, with the corrections that are in force.
        uncertain: Index -> how well a place is known, of those that are corrected, or have not been tested yet.
    """

    def __init__(self, rig: Rig, config: Config) -> None:
        first_monitored = len(rig.pairs) if config.estimates_calibration else 1
        self._alignments = {j: PairAlignment(_prior(rig, j, config)) for j in range(first_monitored, len(rig.groups))}
        self.recalibrate(rig, {})

    @property
    def misaligned(self) -> Mapping[int, Misalignment]:
        """Pairs and single cameras whose extrinsics relative to the first pair are wrong: motions are corrected."""
        return {j: alignment.refuted for j, alignment in self._alignments.items() if alignment.refuted is not None}

    def recalibrate(self, rig: Rig, uncertain: Mapping[int, Float]) -> None:
        """Take another calibration of the cameras, and covariances (6, 6) of pairs' places relative to the first."""
        self._nominal = RigArrays.of(rig)
        self.arrays = self._nominal
        self.uncertain: Mapping[int, Place] = {j: Place(covariance) for j, covariance in uncertain.items()}
        for j, alignment in self._alignments.items():
            if alignment.in_force is not None:
                self._correct(j)

    def learn(self, own: Mapping[int, Refined]) -> None:
        """Compare motions over a keyframe with the first pair's, and correct places that they refute."""
        if 0 not in own:
            return
        for j, alignment in self._alignments.items():
            if j not in own:
                continue
            alignment.add(own[0], own[j])
            if alignment.learn():
                self._correct(j)

    def uncorrected(self, j: int, own: Refined) -> Refined:
        """Return a pair's own motion as it is without the correction in force."""
        back = se3_inverse(self._alignments[j].correction) if j in self._alignments else np.eye(4)
        adjoint = se3_adjoint(back)
        return replace(
            own,
            cur_T_ref=back @ own.cur_T_ref @ se3_inverse(back),
            covariance=adjoint @ own.covariance @ adjoint.T,
        )

    def _correct(self, j: int) -> None:
        """Apply the correction in force of one place, or none."""
        alignment = self._alignments[j]
        self.arrays = self.arrays.corrected(self._nominal, j, alignment.correction)
        others = {i: place for i, place in self.uncertain.items() if i != j}
        self.uncertain = others if alignment.in_force is None else {**others, j: alignment.in_force.place}


def _prior(rig: Rig, j: int, config: Config) -> Float | None:
    """Return the covariance (6, 6) of a single camera's extrinsics where calibrations are not taken for exact."""
    if j < len(rig.pairs) or not config.estimates_calibration:
        return None
    known, camera = rig.calibration_sigmas, rig.groups[j].left
    of_lens = np.sqrt(2.0) * known.principal_point_px / camera.focal_px  # of both cameras; it turns their views
    turn = np.hypot(np.deg2rad(known.pair_rotation_deg), of_lens)
    about_camera = np.eye(6)
    about_camera[3:, :3] = skew(camera.body_T_cam[:3, 3])
    covariance = np.diag(np.repeat([turn, known.pair_translation_m], 3) ** 2)
    return np.asarray(about_camera @ covariance @ about_camera.T)

"""A front-end with rendered images and random drift: a rig that moves in circles in the calibration room."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from calibration_walks import walk_simulator
from rendered import rendered_once
from synthetic_front_end import SyntheticFrontEnd

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.config.stages import OptimizationConfig
from graphvio.errors import SourceError
from graphvio.geometry import se3_inverse
from graphvio.image_decoding import read_grey
from graphvio.mapping.mapper import Mapper
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig
from graphvio.simulation import Simulator, write_recording
from graphvio.slam.keyframe import CorrectionResult

ROUND_S, WHOLE_S = 8.0, 12.0
SIGMAS = (np.deg2rad(0.2), 0.03)  # much for the few metres that are walked
LATER_NS = 10**15  # between two sessions
CONFIG = replace(
    Config(),
    optimization=OptimizationConfig(place_distance_m=0.3, place_angle_deg=20.0, features=400, loop_interval_s=5.0),
)


def around(t: Float) -> Float:
    """A circle once in `ROUND_S`, looking along it."""
    angle, zero = 2.0 * np.pi / ROUND_S * t, np.zeros_like(t)
    return np.column_stack(
        [0.9 * np.cos(angle), 0.9 * np.sin(angle), 1.45 + zero, angle + 0.5 * np.pi, zero, 0.03 * np.sin(3.0 * t)]
    )


@cache
def simulator() -> Simulator:
    return walk_simulator(WHOLE_S, around)


@cache
def rendered(index: int) -> FrameSet:
    """A frameset of the recording of the whole walk."""
    folder = rendered_once("walk", lambda path: write_recording(simulator(), path), around.__name__, WHOLE_S)
    stamp_ns, images = int(simulator().stamps_ns[index]), {}
    for j, pair in enumerate(simulator().rig.pairs):
        left, right = (
            read_grey(folder / f"mav0/{camera.name}/data/{stamp_ns}.png") for camera in (pair.left, pair.right)
        )
        images[j] = left, right
    return FrameSet(stamp_ns, images)


class Refusing(SyntheticFrontEnd):
    """Refuses corrections; the first one raises."""

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        result = super().correct(keyframe_id, map_T_body, covariance)
        if len(self.corrections) == 1:
            raise SourceError("the wire is cut")
        return replace(result, accepted=False, reason="too far off")


def front_end(
    first: int,
    last: int,
    seed: int,
    step: int = 4,
    session: int = 0,
    breaks: Collection[int] = (),
    kind: type[SyntheticFrontEnd] = SyntheticFrontEnd,
    rig: Rig | None = None,
    sigmas: tuple[float, float] = SIGMAS,
) -> tuple[SyntheticFrontEnd, Float]:
    """Keyframes of some framesets, 20 a second, and their true poses in the first one's.

    Args:
        first: frameset.
        last: not taken any more.
        seed: of the drift.
        step: from keyframe to keyframe.
        session: number of the session, which offsets its stamps.
        breaks: keyframes with which epochs begin.
        kind: of front-end.
        rig: single cameras of the simulator's rig, or None for its pairs.
        sigmas: of the drift, radians and metres after a metre.
    """
    indices = np.arange(first, last, step)
    truth = simulator().world_T_body[indices]
    stamps = simulator().stamps_ns[indices] + session * LATER_NS
    index_of = dict(zip(stamps.tolist(), indices.tolist(), strict=True))

    def frameset_at(stamp_ns: int) -> FrameSet:
        images = rendered(index_of[stamp_ns]).images
        if rig is not None:
            whole = simulator().rig.groups
            of_camera = {c.name: i for j, each in images.items() for c, i in zip(whole[j].cameras, each, strict=True)}
            images = {j: (of_camera[single.name],) for j, single in enumerate(rig.singles)}
        return FrameSet(stamp_ns, images)

    odom_T_body = se3_inverse(truth[0]) @ truth
    made = kind(rig or simulator().rig, stamps.tolist(), odom_T_body, frameset_at, sigmas, seed, breaks)
    return made, truth


def mapped(made: SyntheticFrontEnd, map_folder: Path | None = None, save: Path | None = None) -> Mapper:
    """A mapper that has worked on all keyframes; what it kept on disk is gone, or saved."""
    with Mapper(made, CONFIG, map_folder) as mapper:
        made.has_room = lambda: mapper.summary()["places_waiting"] in (0, 1)
        mapper.run()
        if save is not None:
            mapper.save(save)
    return mapper

"""After the warm-up, the first framesets find every kernel compiled."""

from typing import Any

import numpy as np

import graphvio.kernels
from graphvio import FrameSet, ImuSample, Odometry
from graphvio.config import Config
from graphvio.frontend.visual import VisualFrontend
from graphvio.simulation import default_rig, make_simulator
from graphvio.slam import FrontEnd
from graphvio.slam.keyframe import Keyframe
from graphvio.warmup import warm_up

_FRAMES = 6


def compiled() -> set[tuple[str, str, Any]]:
    """Each kernel's module, name and signatures."""
    return {
        (kernel.py_func.__module__, kernel.py_func.__name__, signature)
        for kernel in graphvio.kernels._registered
        for signature in kernel.signatures
    }


def test_no_kernel_is_compiled_after_the_warm_up() -> None:
    simulator = make_simulator("room", duration_s=0.5)
    framesets = [simulator.frameset(k) for k in range(_FRAMES)]
    track = simulator.imu_track
    samples = [
        ImuSample(int(stamp_ns), rate, force)
        for stamp_ns, rate, force in zip(
            track.stamps_ns, track.angular_velocity, track.linear_acceleration, strict=True
        )
    ]
    warm_up(default_rig(), Config())
    before = compiled()
    assert len(before) > 20
    assert "_linearised" in {name for _, name, _ in before}  # of pairs' places, needed after some keyframes
    frontend = VisualFrontend(simulator.rig, Config())
    for frameset in framesets:
        result = frontend.process(frameset, lambda _: np.eye(4))
    frontend.close()
    assert result.motion is not None
    assert compiled() - before == set()
    both: list[FrameSet | ImuSample] = [*samples, *framesets]
    measurements = sorted(both, key=lambda measurement: measurement.stamp_ns)
    for rig in (simulator.rig, simulator.rig.without_imu()):
        odometry = Odometry(rig)
        keyframes: list[Keyframe] = []
        FrontEnd(odometry).on_keyframe(keyframes.append)
        for measurement in measurements if rig.imu is not None else framesets:
            odometry.process(measurement)
        odometry.finish()
        assert keyframes
        assert compiled() - before == set()

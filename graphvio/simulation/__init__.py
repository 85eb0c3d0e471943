"""Simulator of images and IMU samples of a rig that is carried through textured worlds.

`simulate` writes a recording; `make_simulator` provides the same images, IMU samples and truth in memory.
"""

from graphvio.simulation.calibration_error import CalibrationErrorSizes
from graphvio.simulation.default_rig import default_rig
from graphvio.simulation.recording import SimulatedRecording, simulate, write_recording
from graphvio.simulation.rig_change import RIG_CHANGES
from graphvio.simulation.scenes import SCENE_NAMES, build_scene
from graphvio.simulation.simulator import Simulator, make_simulator

__all__ = [
    "RIG_CHANGES",
    "SCENE_NAMES",
    "CalibrationErrorSizes",
    "SimulatedRecording",
    "Simulator",
    "build_scene",
    "default_rig",
    "make_simulator",
    "simulate",
    "write_recording",
]

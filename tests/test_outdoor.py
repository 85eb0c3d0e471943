"""The outdoor scenes: the odometry with exact files, where most of what is seen is far away for the baseline."""

from pathlib import Path

import pytest
from recordings import scaled
from rendered import rendered_once

from graphvio.config import Config
from graphvio.odometry import Odometry
from graphvio.pipeline import run
from graphvio.results import ResultWriter
from graphvio.simulation import Simulator, build_scene, write_recording
from graphvio.simulation.named_rigs import NAMED_RIGS
from graphvio.sources import open_source

pytestmark = pytest.mark.usefixtures("without_plots")

DURATION_S = 6.0
RATE_HZ = 10.0


@pytest.mark.parametrize(("scene", "length_m", "max_ate_m"), [("street", 18.0, 0.01), ("flight", 45.0, 0.3)])
def test_run_outdoors_has_no_reset_and_bounded_error(
    scene: str, length_m: float, max_ate_m: float, tmp_path: Path
) -> None:
    def write(folder: Path) -> None:
        built = build_scene(scene, DURATION_S)
        rig = NAMED_RIGS[built.rig]().with_cameras(lambda camera: scaled(camera, 0.375))
        write_recording(Simulator(built, rig, 0, RATE_HZ), folder)

    recording = rendered_once(scene, write, "0.375 size", DURATION_S)
    source = open_source(recording)
    with ResultWriter(tmp_path / "out", source.rig, Config().to_yaml()) as writer:
        summary = run(source, Odometry(source.rig, Config()), writer)
    assert summary.completion == 1.0
    assert summary.resets == 0
    assert summary.evaluation is not None
    assert summary.evaluation["ate_position_m"]["rmse"] < max_ate_m
    assert summary.path_length_m > length_m

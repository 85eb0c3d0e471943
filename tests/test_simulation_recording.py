import hashlib
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from recordings import half_size_rig
from rendered import modules_that_write
from typer.testing import CliRunner

from graphvio import simulation
from graphvio.cli.simulate import simulate as simulate_command
from graphvio.errors import SourceError
from graphvio.rig_files import load_rig
from graphvio.simulation import SimulatedRecording, make_simulator, simulate

DURATION_S = 0.5
SCENE = "corridor"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> SimulatedRecording:
    out = tmp_path_factory.mktemp("simulated") / "one"
    return simulate(SCENE, out, duration_s=DURATION_S, seed=5, stationary_s=0.0, rig=half_size_rig())


def digest(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def test_simulate_writes_euroc_layout(recording: SimulatedRecording) -> None:
    mav0 = recording.path / "mav0"
    assert recording.framesets == 10
    assert recording.images == 40
    stamps = []
    for k in range(4):
        rows = (mav0 / f"cam{k}" / "data.csv").read_text().splitlines()
        assert rows[0].startswith("#timestamp [ns],filename")
        assert len(rows) == 11
        stamps = [int(row.split(",")[0]) for row in rows[1:]]
        for row in rows[1:]:
            image = cv2.imread(str(mav0 / f"cam{k}" / "data" / row.split(",")[1]), cv2.IMREAD_UNCHANGED)
            assert image is not None
            assert image.shape == (240, 320)
            assert image.dtype == np.uint8
        assert (mav0 / f"cam{k}" / "sensor.yaml").is_file()
    imu = np.loadtxt(mav0 / "imu0" / "data.csv", delimiter=",")
    truth = np.loadtxt(mav0 / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    assert imu.shape == (101, 7)
    assert truth.shape == (101, 17)
    imu_stamps = [int(row.split(",")[0]) for row in (mav0 / "imu0" / "data.csv").read_text().splitlines()[1:]]
    assert set(stamps) <= set(imu_stamps)
    assert imu_stamps[0] <= stamps[0]
    assert imu_stamps[-1] >= stamps[-1]
    np.testing.assert_allclose(np.linalg.norm(truth[:, 4:8], axis=1), 1.0, atol=1e-9)
    assert recording.path_length_m == pytest.approx(1.2 * DURATION_S, rel=0.15)


def test_simulate_files_equal_simulator(recording: SimulatedRecording) -> None:
    simulator = make_simulator(SCENE, duration_s=DURATION_S, seed=5, stationary_s=0.0, rig=half_size_rig())
    stamp = simulator.stamps_ns[4]
    path = recording.path / "mav0" / "cam2" / "data" / f"{stamp}.png"
    written = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert written is not None
    assert np.array_equal(written, simulator.image(4, 2))


def test_simulate_same_seed_same_bytes_for_any_threads(
    recording: SimulatedRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0}, raising=False)
    simulate(
        SCENE,
        tmp_path / "b",
        duration_s=DURATION_S,
        seed=5,
        stationary_s=0.0,
        rig=half_size_rig(),
        progress=lambda a, b: calls.append((a, b)),
    )
    assert digest(tmp_path / "b") == digest(recording.path)
    assert calls[-1] == (10, 10)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(5)), raising=False)
    simulate(SCENE, tmp_path / "c", duration_s=DURATION_S, seed=5, stationary_s=0.0, rig=half_size_rig())
    assert digest(tmp_path / "c") == digest(recording.path)


@pytest.mark.parametrize("where", ["rig.yaml", "mav0/cam0/sensor.yaml"])
def test_simulate_rig_is_read_back(recording: SimulatedRecording, where: str) -> None:
    expected = half_size_rig()
    rig = load_rig(recording.path / where)
    assert len(rig.pairs) == 2
    assert rig.imu == expected.imu
    for a, b in zip(rig.cameras, expected.cameras, strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.body_T_cam, b.body_T_cam, atol=1e-9)
        np.testing.assert_allclose(a.intrinsics, b.intrinsics)
        np.testing.assert_allclose(a.distortion, b.distortion)


def test_simulate_nonempty_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SourceError, match="not empty"):
        simulate("room", tmp_path, duration_s=0.1)
    with pytest.raises(SourceError, match="not empty"):
        simulate("room", tmp_path / "notes.txt", duration_s=0.1)


def command() -> typer.Typer:
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(simulate_command)
    return app


def test_command_writes_recording(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        command(), ["room", "--out", str(tmp_path / "r"), "--duration", "0.2", "--rate", "10", "--seed", "1"]
    )
    assert result.exit_code == 0, result.output
    assert "2 framesets, 8 images" in result.output
    assert (tmp_path / "r" / "rig.yaml").is_file()


def test_command_lists_scenes(tmp_path: Path) -> None:
    result = CliRunner().invoke(command(), ["kitchen", "--out", str(tmp_path / "r")])
    assert isinstance(result.exception, SourceError)
    for name in ("room", "corridor", "stairs", "loop", "calibration"):
        assert name in str(result.exception)


def test_recordings_are_kept_for_as_long_as_what_writes_them_is_the_same() -> None:
    """Tests render again after a change of any module of the simulator, and not after one of what reads."""
    found = set(modules_that_write())
    root = Path(simulation.__file__).parent
    modules = {path.relative_to(root).with_suffix("") for path in root.rglob("*.py")}
    written_by = {f"graphvio.simulation.{'.'.join(each.parts)}" for each in modules if each.name != "__init__"}
    assert written_by <= found
    assert {"graphvio.cameras", "graphvio.rig", "graphvio.kernels", "graphvio.sessions.euroc_layout"} < found
    assert not {"graphvio.errors", "graphvio.wording", "graphvio.rig_files.reading"} & found

import importlib
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphvio.errors import GraphvioError, MissingExtraError
from graphvio.geometry import se3, so3_exp
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import Event, EventKind
from graphvio.measurements.motion import PairReport
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Camera, Imu, Rig, StereoPair
from graphvio.rig_files import save_rig
from graphvio.self_calibration.curves import curves_of
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.evidence import Gaussian
from graphvio.self_calibration.prior import file_prior
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import save_trajectory
from graphvio.viewer import Viewer

pytest.importorskip("rerun")

START_NS = 1_403_636_579_763_555_584


def some_rig() -> Rig:
    def camera(name: str, y: float) -> Camera:
        body_T_cam = np.array([[0.0, 0, 1, 0], [-1, 0, 0, y], [0, -1, 0, 0], [0, 0, 0, 1]])
        return Camera(name, "radial-tangential", (640, 480), np.array([400.0, 400, 320, 240]), np.zeros(5), body_T_cam)

    return Rig((StereoPair("front", camera("cam0", 0.05), camera("cam1", -0.05)),), Imu(), "test")


def estimate(k: int) -> Estimate:
    lost = 40 <= k < 45
    return Estimate(
        START_NS + k * 50_000_000,
        Status.LOST if lost else Status.TRACKING,
        None if lost else se3(so3_exp(np.array([0.0, 0.0, 0.01 * k])), np.array([0.1 * k, 0.0, 0.0])),
        None if lost else np.eye(6) * 1e-4,
        epoch=int(k >= 45),
        gyro_bias=np.full(3, 1e-3),
        accel_bias=np.zeros(3),
        rates={"gyro": np.ones(3), "vision": np.ones(3), "fused": np.ones(3)},
        pairs={0: PairReport(50, 40, np.full((50, 2), 100.0), np.arange(50) < 40)},
        stage_ms={"track": 3.0},
    )


def frameset(k: int) -> FrameSet:
    image = np.full((480, 640), k % 256, dtype=np.uint8)
    return FrameSet(START_NS + k * 50_000_000, {0: (image, image)})


def printed(*arguments: str) -> str:
    command = [sys.executable, "-m", "rerun", "rrd", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout


def rows_of(file: Path) -> dict[str, int]:
    """Entity -> rows of data, as rerun's own reader counts them."""
    counts: dict[str, int] = {}
    for chunk in importlib.import_module("rerun.chunk").RrdReader(file).stream():
        counts[chunk.entity_path] = counts.get(chunk.entity_path, 0) + chunk.num_rows
    return counts


def scalars_of(file: Path, entity: str) -> dict[int, float]:
    """Stamp -> value, of an entity that holds one number at a time."""
    values: dict[int, float] = {}
    for chunk in importlib.import_module("rerun.chunk").RrdReader(file).stream():
        if chunk.entity_path == entity:
            rows = chunk.to_record_batch()
            since_ns = rows.column("time").cast("int64").to_pylist()
            numbers = [number for (number,) in rows.column("Scalars:scalars").to_pylist()]
            values.update(zip((START_NS + ns for ns in since_ns), numbers, strict=True))
    return values


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file: Path = tmp_path_factory.mktemp("viewer") / "run.rrd"
    with Viewer(some_rig(), save=file) as viewer:
        for k in range(250):
            viewer.show(frameset(k), estimate(k))
        viewer.show_event(Event(START_NS, EventKind.VISION_GATED, "front"))
        viewer.show_path("smoothed", Trajectory(np.arange(3), np.array([np.eye(4)] * 3)))
    return file


def test_recording_has_every_entity(recording: Path) -> None:
    printed("verify", str(recording))
    entities = rows_of(recording)
    for entity in (
        "/world/rig",
        "/world/rig/cam0",
        "/world/rig/cam1",
        "/world/rig/cam0/image",
        "/world/rig/cam0/corners",
        "/world/rig/uncertainty",
        "/world/trajectory/0/0",
        "/world/trajectory/1/0",
        "/world/trajectory/1/2",
        "/world/smoothed",
        "/rates/x/gyro",
        "/rates/z/fused",
        "/biases/accel",
        "/points/front/inliers",
        "/timing/track",
        "/events",
    ):
        assert entities.get(entity, 0) > 0, entity


def test_viewer_that_is_slow_drops_images_but_no_pose(recording: Path) -> None:
    entities = rows_of(recording)
    assert entities["/world/rig"] == 245  # all but those lost
    assert entities["/world/rig/uncertainty"] == 245
    assert entities["/timing/track"] == 250
    assert 1 <= entities["/world/rig/cam0/image"] < 250
    assert entities["/events"] == 4  # tracking, lost, tracking, and the event


def test_residuals_of_each_pair_are_logged_where_available(tmp_path: Path) -> None:
    shown = []
    for k in range(30):
        joint_px, own_px = 0.3 + 0.01 * k if k else None, 0.1 + 0.02 * k if k % 2 else None
        report = replace(estimate(k).pairs[0], rms_px=joint_px, own_rms_px=own_px)
        shown.append(replace(estimate(k), pairs={0: report}))
    with Viewer(some_rig(), save=tmp_path / "r.rrd") as viewer:
        for each in shown:
            viewer.show(None, each)
    for entity, figure in (("joint", "rms_px"), ("own", "own_rms_px")):
        expected = {e.stamp_ns: getattr(e.pairs[0], figure) for e in shown}
        expected = {stamp: value for stamp, value in expected.items() if value is not None}
        assert scalars_of(tmp_path / "r.rrd", f"/residuals/front/{entity}") == expected
    assert scalars_of(tmp_path / "r.rrd", "/points/front/candidates") == {e.stamp_ns: 50.0 for e in shown}
    assert scalars_of(tmp_path / "r.rrd", "/points/front/inliers") == {e.stamp_ns: 40.0 for e in shown}


def test_calibration_is_logged_with_its_standard_deviations(tmp_path: Path) -> None:
    rig = some_rig()
    prior = file_prior(rig)
    difference = np.zeros(len(prior.group))
    difference[0] = 0.01 * 400.0  # of fx
    posterior = Gaussian(difference, np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64))
    with Viewer(rig, save=tmp_path / "r.rrd") as viewer:
        viewer.show(None, estimate(0))
        for k in (1, 5):
            calibration = CalibrationEstimate(rig, posterior, difference, np.ones(prior.n_groups))
            viewer.show_calibration(START_NS + k * 50_000_000, calibration)
    found: dict[str, list[list[float]]] = {}
    for chunk in importlib.import_module("rerun.chunk").RrdReader(tmp_path / "r.rrd").stream():
        if chunk.entity_path.startswith("/calibration") and "Scalars:scalars" in chunk.to_record_batch().schema.names:
            numbers = chunk.to_record_batch().column("Scalars:scalars").to_pylist()
            found.setdefault(chunk.entity_path, []).extend(numbers)
    assert len(found) == len(curves_of(rig))
    assert found["/calibration/focal_lengths/cam0_fx"] == [pytest.approx([1.0, 0.9, 1.1])] * 2
    assert found["/calibration/IMU__time_offset/value"][0] == pytest.approx([0.0, -2.0, 2.0])


def test_show_returns_while_logging_is_blocked(tmp_path: Path, monkeypatch: Any) -> None:
    from graphvio.viewer.recording import Recording

    every_frame_shown = threading.Event()
    monkeypatch.setattr(Recording, "add_images", lambda *_: every_frame_shown.wait(20.0))
    with Viewer(some_rig(), save=tmp_path / "slow.rrd") as viewer:
        for k in range(100):
            viewer.show(frameset(k), estimate(k))
        assert viewer.dropped in (98, 99)  # all but the newest, and one that the worker may have
        every_frame_shown.set()
    assert rows_of(tmp_path / "slow.rrd")["/timing/track"] == 100


def test_close_after_failure_of_logging_raises(tmp_path: Path, monkeypatch: Any) -> None:
    from graphvio.viewer.recording import Recording

    def fail(*_: object) -> None:
        raise RuntimeError("no more paint")

    monkeypatch.setattr(Recording, "add_estimates", fail)
    viewer = Viewer(some_rig(), save=tmp_path / "f.rrd")
    for k in range(10):
        viewer.show(frameset(k), estimate(k))
        time.sleep(0.005)
    with pytest.raises(GraphvioError, match="no more paint"):
        viewer.close()
    viewer.close()
    assert not [t for t in threading.enumerate() if t.name == "viewer"]


def test_exit_after_error_of_run_and_of_logging_raises_that_of_run(tmp_path: Path, monkeypatch: Any) -> None:
    from graphvio.viewer.recording import Recording

    def fail(*_: object) -> None:
        raise RuntimeError("no more paint")

    monkeypatch.setattr(Recording, "add_estimates", fail)
    with pytest.raises(ZeroDivisionError), Viewer(some_rig(), save=tmp_path / "f.rrd") as viewer:  # noqa: PT012
        viewer.show(None, estimate(0))
        raise ZeroDivisionError


def test_ellipsoid_has_the_axes_of_the_covariance() -> None:
    from graphvio.viewer.recording import ellipsoid

    rotation = so3_exp(np.array([0.3, -0.5, 1.0]))
    half, quat_xyzw = ellipsoid(rotation @ np.diag([0.04, 0.01, 0.09]) @ rotation.T)
    np.testing.assert_allclose(sorted(half), [0.3, 0.6, 0.9])
    from graphvio.geometry import rotation_from_quat_wxyz

    axes = rotation_from_quat_wxyz(quat_xyzw[[3, 0, 1, 2]])
    np.testing.assert_allclose(
        axes @ np.diag((half / 3) ** 2) @ axes.T, rotation @ np.diag([0.04, 0.01, 0.09]) @ rotation.T, atol=1e-12
    )


def test_viewer_without_display_raises_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(GraphvioError, match="no display") as caught:
        Viewer(some_rig(), spawn=True)
    assert "\n" not in str(caught.value)


def test_viewer_without_rerun_raises_with_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "rerun"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "graphvio.viewer.recording", raising=False)
    monkeypatch.delitem(sys.modules, "graphvio.viewer.layout", raising=False)

    class Absent:
        def find_spec(self, name: str, *_: object) -> None:
            if name == "rerun":
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(sys, "meta_path", [Absent(), *sys.meta_path])
    with pytest.raises(MissingExtraError, match=r"pip install 'graphvio\[viewer\]'"):
        Viewer(some_rig(), save=tmp_path / "x.rrd")


def test_viewer_with_unusable_path_raises(tmp_path: Path) -> None:
    with pytest.raises(GraphvioError, match="cannot be written"):
        Viewer(some_rig(), save=tmp_path / "no" / "x.rrd")
    with pytest.raises(GraphvioError, match="cannot be opened"):
        Viewer(some_rig(), save=tmp_path)


def test_replay_shows_result_folder(tmp_path: Path) -> None:
    from graphvio.results import FinishedRun, ResultWriter
    from graphvio.viewer.replay import read_estimates, replay

    folder = tmp_path / "run-1"
    shown = [estimate(k) for k in range(60)]
    with ResultWriter(folder, some_rig(), "") as writer:
        for each in shown:
            writer.add(each)
        writer.add_event(Event(START_NS, EventKind.VISION_GATED, "front"))
        smoothed = [(e.stamp_ns, e.nav_T_body) for e in shown if e.nav_T_body is not None]
        writer.finish(
            FinishedRun(
                wall_s=1.0, frameset_ms=[], smoothed=smoothed, input_faults={}, framesets=60, awaited=60, resets=1
            )
        )
    read = list(read_estimates(folder))
    assert [e.epoch for e in read] == [e.epoch for e in shown if e.nav_T_body is not None]
    np.testing.assert_allclose(np.asarray(read[3].covariance), np.eye(6) * 1e-4)
    np.testing.assert_allclose(np.asarray(read[3].gyro_bias), 1e-3)

    replay(folder, save=tmp_path / "again.rrd")
    entities = rows_of(tmp_path / "again.rrd")
    assert entities["/world/rig"] == 55
    assert entities["/world/trajectory/1/0"] > 0
    assert entities["/world/smoothed"] > 0
    assert entities["/biases/gyro"] >= 55

    (folder / "covariance.csv").write_text("header\n1,2,3\n")
    with pytest.raises(GraphvioError, match=r"covariance\.csv, line 2: is damaged"):
        replay(folder, save=tmp_path / "again.rrd")
    with pytest.raises(GraphvioError, match=r"holds no trajectory\.txt"):
        replay(tmp_path, save=tmp_path / "again.rrd")


def test_view_command_exit_codes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from graphvio.cli import main

    def code_of(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["graphvio", "view", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    save_rig(some_rig(), tmp_path / "rig.yaml")
    save_trajectory(
        Trajectory(np.array([1, 2]), np.array([np.eye(4)] * 2)), tmp_path / "trajectory.txt"
    )  # a broken-off run
    assert code_of(str(tmp_path), "--save-rrd", str(tmp_path / "out.rrd")) == 0
    assert rows_of(tmp_path / "out.rrd")["/world/rig"] == 2
    assert code_of(str(tmp_path)) == 2
    assert code_of(str(tmp_path / "absent")) == 2
    shown = capsys.readouterr().err.splitlines()
    assert len(shown) == 2
    assert "no display" in shown[0]
    assert "is no folder" in shown[1]

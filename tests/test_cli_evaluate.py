import json
from pathlib import Path

import numpy as np
import pytest

from graphvio.cli import main
from graphvio.geometry import se3, so3_exp
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import save_trajectory

START_NS = 1_403_636_579_763_555_584


def walk(scale: float = 1.0) -> Trajectory:
    u = np.linspace(0.0, 2.0 * np.pi, 400)
    positions = scale * np.column_stack([4 * np.sin(u), 3 * (1 - np.cos(u)), 0.2 * np.sin(2 * u)])
    poses = np.array([se3(so3_exp(np.array([0.0, 0.0, a])), p) for a, p in zip(u, positions, strict=True)])
    return Trajectory(START_NS + np.arange(400) * 50_000_000, poses)


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Return the exit code of the program, as a shell would see it."""
    monkeypatch.setattr("sys.argv", ["graphvio", *map(str, arguments)])
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    save_trajectory(walk(1.01), tmp_path / "estimate.txt")
    rows = (
        f"{stamp},{','.join(f'{v:.9f}' for v in pose[:3, 3])},{np.cos(a / 2):.12f},0,0,{np.sin(a / 2):.12f}"
        for stamp, pose, a in zip(walk().stamps_ns, walk().nav_T_body, np.linspace(0.0, 2.0 * np.pi, 400), strict=True)
    )
    (tmp_path / "data.csv").write_text("#timestamp [ns],x,y,z,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    return tmp_path / "estimate.txt", tmp_path / "data.csv"


def test_evaluate_writes_table_figures_and_picture(
    files: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = run(monkeypatch, "evaluate", *files, "--plot", tmp_path / "e.png", "--save-json", tmp_path / "e.json")
    assert code == 0
    shown = capsys.readouterr().out
    assert "400 of 400 poses have a true one" in shown
    for row in ("ATE, position", "ATE, rotation", "RPE over 10 m, position", "drift", "loop closure"):
        assert row in shown
    figures = json.loads((tmp_path / "e.json").read_text())
    assert figures["rpe"]["1 m"]["percent"] == pytest.approx(1.0, rel=0.01)
    assert figures["ate_rotation_deg"]["max"] < 1e-3
    assert f"{figures['ate_position_m']['rmse']:.4f} m" in shown
    assert (tmp_path / "e.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "holds no pose"), ("1 2 3\n", "line 1: has 3 columns"), ("5.0 0 0 0 0 0 0 1\n", "at least 3 are needed")],
)
def test_evaluate_bad_file_is_one_line(
    files: tuple[Path, Path],
    text: str,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    files[0].write_text(text)
    assert run(monkeypatch, "evaluate", *files) == 2
    shown = capsys.readouterr()
    assert message in shown.err
    assert shown.err.count("\n") == 1
    assert shown.out == ""


def test_evaluate_max_gap_limits_interpolation(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_trajectory(walk().select(np.arange(0, 400, 10)), tmp_path / "sparse.txt")
    for gap, expected in ((0.25, 40), (0.6, 391)):
        code = run(
            monkeypatch,
            *("evaluate", files[0], tmp_path / "sparse.txt", "--max-gap", gap, "--save-json", tmp_path / "e.json"),
        )
        assert code == 0
        assert json.loads((tmp_path / "e.json").read_text())["associated"] == expected


def test_evaluate_unwritable_json_is_an_error(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "evaluate", *files, "--save-json", files[0].parent / "no" / "e.json") == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_result_folder_is_taken_for_its_trajectory(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = tmp_path / "result"
    result.mkdir()
    (result / "trajectory.txt").write_bytes(files[0].read_bytes())
    tables = []
    for given in (files[0], result):
        assert run(monkeypatch, "evaluate", given, files[1]) == 0
        tables.append(capsys.readouterr().out)
    assert tables[0] == tables[1]


def test_a_recording_is_taken_for_its_truth(
    room_walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = next((room_walk / "mav0").glob("state_groundtruth_estimate0/data.csv"))
    tables = []
    for given in (truth, room_walk):
        assert run(monkeypatch, "evaluate", truth, given) == 0
        tables.append(capsys.readouterr().out)
    assert tables[0] == tables[1]
    assert "ATE, position" in tables[0]


def test_a_recording_without_a_truth_is_named(
    room_walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    walk, truth = tmp_path / "walk", room_walk / "mav0/state_groundtruth_estimate0/data.csv"
    (walk / "mav0").mkdir(parents=True)
    for sensor in (room_walk / "mav0").iterdir():
        if sensor.name != "state_groundtruth_estimate0":
            (walk / "mav0" / sensor.name).symlink_to(sensor)
    (walk / "rig.yaml").symlink_to(room_walk / "rig.yaml")
    assert run(monkeypatch, "evaluate", truth, walk) == 2
    assert f"{walk}: this recording has no true trajectory" in capsys.readouterr().err

"""Calibration errors of simulated recordings: their statistics, what files and data hold, rigs that change."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import typer
from benchmarks.calibration_differences import calibration_differences
from recordings import half_size_rig
from scipy.stats import chi2
from typer.testing import CliRunner

from graphvio.arrays import Float
from graphvio.cli.simulate import simulate as simulate_command
from graphvio.errors import SourceError
from graphvio.geometry import so3_log
from graphvio.rig import Rig
from graphvio.rig_files import load_rig
from graphvio.simulation import (
    RIG_CHANGES,
    CalibrationErrorSizes,
    SimulatedRecording,
    Simulator,
    build_scene,
    default_rig,
    simulate,
)
from graphvio.simulation.calibration_error import COMPONENTS, LEVELS, draw
from graphvio.simulation.imu import ideal_readings, measure
from graphvio.simulation.rig_change import Knock, RigChange, ThermalDrift

DRAWS = 300
DURATION_S = 0.4
RIG_FIELDS = [name for names in COMPONENTS.values() for name in names if not name.startswith("imu_")]


def differences(error: CalibrationErrorSizes, seed: int) -> dict[str, Float]:
    sampled = draw(default_rig(), error, seed)
    return calibration_differences(sampled.written_rig, sampled.true_rig)


def assert_rms(values: Float, sigma: float) -> None:
    """Independent errors have mean zero and the standard deviation that is wanted, in bands of 1e-5."""
    n = values.size
    low, high = chi2.ppf([1e-5, 1 - 1e-5], n)
    assert low < float(np.sum((values / sigma) ** 2)) < high
    assert abs(values.mean()) < 4.3 * sigma / np.sqrt(n)


# ---------------------------------------------------------------- draws


@pytest.mark.parametrize("level", LEVELS)
def test_draw_many_seeds_errors_have_the_sizes_of_the_level(level: int) -> None:
    error = CalibrationErrorSizes.of_level(level)
    found = [differences(error, seed) for seed in range(DRAWS)]
    for name in RIG_FIELDS:
        values = np.array([each[name] for each in found])
        if name == "time_offset_ms":
            np.testing.assert_allclose(np.abs(values), error.time_offset_ms, rtol=1e-9)
            assert 0.3 < np.mean(values > 0.0) < 0.7
        else:
            assert_rms(values, getattr(error, name))


def test_draw_many_seeds_imu_matrices_have_their_sizes() -> None:
    error = CalibrationErrorSizes.of_level(3)
    sampled = [draw(default_rig(), error, seed).imu for seed in range(DRAWS)]
    off_diagonal = ~np.eye(3, dtype=bool)
    for matrices in (
        np.array([each.gyro_matrix for each in sampled]),
        np.array([each.accel_matrix for each in sampled]),
    ):
        assert_rms(100.0 * (matrices[:, ~off_diagonal] - 1.0), error.imu_scale_percent)
        assert_rms(np.rad2deg(matrices[:, off_diagonal]), error.imu_misalignment_deg)


def test_draw_focal_error_is_common_to_both_axes_of_a_camera() -> None:
    sampled = draw(default_rig(), CalibrationErrorSizes.of_level(2), 1)
    pairs = zip(sampled.written_rig.cameras, sampled.true_rig.cameras, strict=True)
    ratios = np.array([written.intrinsics[:2] / true.intrinsics[:2] for written, true in pairs])
    np.testing.assert_allclose(ratios[:, 0], ratios[:, 1], rtol=1e-12)
    assert len(np.unique(ratios[:, 0].round(9))) == 4


@pytest.mark.parametrize("component", COMPONENTS)
def test_draw_one_component_is_as_among_all_and_leaves_others_exact(component: str) -> None:
    alone, everything = CalibrationErrorSizes.of_level(2, [component]), CalibrationErrorSizes.of_level(2)
    one, whole = differences(alone, 7), differences(everything, 7)
    for name in RIG_FIELDS:
        if name in COMPONENTS[component]:
            np.testing.assert_allclose(one[name], whole[name], rtol=1e-6, atol=1e-9)
            assert np.abs(one[name]).max() > 0.0
        else:
            np.testing.assert_allclose(one[name], 0.0, atol=1e-9)


def test_draw_without_error_changes_nothing() -> None:
    rig = default_rig()
    sampled = draw(rig, CalibrationErrorSizes(), 3)
    assert sampled.written_rig.imu == sampled.true_rig.imu == rig.imu
    for name, values in calibration_differences(sampled.written_rig, rig).items():
        np.testing.assert_allclose(values, 0.0, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(sampled.imu.gyro_matrix, np.eye(3))
    np.testing.assert_array_equal(sampled.imu.accel_matrix, np.eye(3))


def test_draw_true_rig_has_the_true_cameras_and_the_true_imu() -> None:
    rig = default_rig()
    sampled = draw(rig, CalibrationErrorSizes.of_level(3), 2)
    assert sampled.true_rig.pairs == rig.pairs
    assert sampled.written_rig.imu == rig.imu
    assert sampled.true_rig.imu is not None
    assert rig.imu is not None
    assert abs(sampled.true_rig.imu.time_offset_s) == pytest.approx(8e-3)
    assert sampled.true_rig.imu.gyro_noise_density == pytest.approx(2.2 * rig.imu.gyro_noise_density)
    assert sampled.true_rig.imu.accel_noise_density == pytest.approx(2.2 * rig.imu.accel_noise_density)


def test_draw_levels_of_one_seed_have_one_direction() -> None:
    first, third = (differences(CalibrationErrorSizes.of_level(level), 4) for level in (1, 3))
    for name in ("principal_point_px", "focal_percent", "baseline_percent", "left_right_deg"):
        np.testing.assert_allclose(third[name], 10.0 * first[name], rtol=1e-6)


@pytest.mark.parametrize(
    "make",
    [
        lambda: CalibrationErrorSizes(focal_percent=-0.1),
        lambda: CalibrationErrorSizes(time_offset_ms=float("nan")),
        lambda: CalibrationErrorSizes(imu_noise_factor=0.0),
        lambda: CalibrationErrorSizes.of_level(4),
        lambda: CalibrationErrorSizes.of_level(2, ["lens"]),
        lambda: draw(default_rig(), CalibrationErrorSizes(), -1),
    ],
)
def test_calibration_error_impossible_value_is_refused(make: Callable[[], object]) -> None:
    with pytest.raises(SourceError):
        make()


# ---------------------------------------------------------------- the IMU's data


def test_measure_imu_error_multiplies_rates_and_forces_and_shifts_stamps() -> None:
    """Noise and biases are the same numbers with and without error, so that differences are exact."""
    motion = build_scene("room", 3.0, 0.0).motion
    times_s = np.linspace(0.0, 3.0, 601)
    stamps_ns = np.round(1e9 * times_s).astype(np.int64)
    sampled = draw(default_rig(), CalibrationErrorSizes.of_level(3), 5)
    assert sampled.written_rig.imu is not None
    assert sampled.true_rig.imu is not None
    exact = measure(motion, sampled.written_rig.imu, times_s, stamps_ns, 1)
    wrong = measure(motion, sampled.true_rig.imu, times_s, stamps_ns, 1, sampled.imu)
    offset_ns = sampled.true_rig.imu.time_offset_ns
    assert abs(offset_ns) == 8_000_000
    np.testing.assert_array_equal(wrong.stamps_ns, stamps_ns + offset_ns)
    np.testing.assert_array_equal(wrong.true_stamps_ns, stamps_ns)
    np.testing.assert_array_equal(wrong.gyro_bias, exact.gyro_bias)
    rate, force = ideal_readings(exact.states)
    for matrix, true, bias, with_error, without in (
        (sampled.imu.gyro_matrix, rate, exact.gyro_bias, wrong.angular_velocity, exact.angular_velocity),
        (sampled.imu.accel_matrix, force, exact.accel_bias, wrong.linear_acceleration, exact.linear_acceleration),
    ):
        noise = without - true - bias
        np.testing.assert_allclose(with_error, true @ matrix.T + bias + 2.2 * noise, atol=1e-12)


# ---------------------------------------------------------------- recordings


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulatedRecording, SimulatedRecording]:
    """One with exact files, and one with wrong files."""
    folder = tmp_path_factory.mktemp("calibration-error")
    exact = simulate("room", folder / "exact", duration_s=DURATION_S, seed=2, rate_hz=10.0)
    error = CalibrationErrorSizes.of_level(2)
    wrong = simulate(
        "room",
        folder / "wrong",
        duration_s=DURATION_S,
        seed=2,
        rate_hz=10.0,
        calibration_error=error,
        calibration_seed=9,
    )
    return exact, wrong


def digests(folder: Path, pattern: str) -> dict[str, str]:
    files = sorted(folder.glob(pattern))
    assert files
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def assert_same_cameras(rig: Rig, expected: Rig) -> None:
    for name, values in calibration_differences(rig, expected).items():
        np.testing.assert_allclose(values, 0.0, atol=1e-6, err_msg=name)


def test_simulate_calibration_error_leaves_images_and_truth_as_they_are(
    recordings: tuple[SimulatedRecording, SimulatedRecording],
) -> None:
    exact, wrong = recordings
    for pattern in ("mav0/cam*/data/*.png", "mav0/cam*/data.csv", "mav0/state_groundtruth_estimate0/*"):
        assert digests(exact.path, pattern) == digests(wrong.path, pattern)
    imu = "mav0/imu0/data.csv"
    assert digests(exact.path, imu) != digests(wrong.path, imu)
    assert not (exact.path / "rig-true.yaml").exists()


def test_simulate_calibration_error_files_are_wrong_and_the_true_ones_beside(
    recordings: tuple[SimulatedRecording, SimulatedRecording],
) -> None:
    _, wrong = recordings
    sampled = draw(default_rig(), CalibrationErrorSizes.of_level(2), 9)
    for file in ("rig.yaml", "mav0/cam0/sensor.yaml"):
        assert_same_cameras(load_rig(wrong.path / file), sampled.written_rig)
    assert load_rig(wrong.path).imu == sampled.written_rig.imu
    true = load_rig(wrong.path / "rig-true.yaml")
    assert_same_cameras(true, sampled.true_rig)
    assert true.imu == sampled.true_rig.imu
    samples = np.loadtxt(wrong.path / "mav0" / "imu0" / "data.csv", delimiter=",", usecols=0, dtype=np.int64)
    truth = np.loadtxt(
        wrong.path / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=",", usecols=0, dtype=np.int64
    )
    assert true.imu is not None
    np.testing.assert_array_equal(samples - truth, true.imu.time_offset_ns)


# ---------------------------------------------------------------- rigs that change


@pytest.mark.parametrize(("change", "index"), [(ThermalDrift(period_s=10.0), 5), (Knock(), 4)])
def test_view_of_changed_rig_equals_that_of_a_rig_that_was_so_from_the_start(change: RigChange, index: int) -> None:
    scene, rig = build_scene("room", 3.0, 0.5), half_size_rig()
    changing = Simulator(scene, rig, rate_hz=2.0, rig_change=change)
    constant = Simulator(scene, changing.rig_at(index), rate_hz=2.0)
    unchanged = Simulator(scene, rig, rate_hz=2.0)
    for camera in (0, 1):
        before = changing.view(0, camera)
        np.testing.assert_array_equal(before.radiance, unchanged.view(0, camera).radiance)
        after = changing.view(index, camera)
        np.testing.assert_array_equal(after.radiance, constant.view(index, camera).radiance)
        assert np.abs(after.radiance - unchanged.view(index, camera).radiance).max() > 1e-3


def test_thermal_drift_after_its_period_has_its_whole_size() -> None:
    rig, change = default_rig(), RIG_CHANGES["thermal"]
    assert [change.stage_at(time_s, 600.0) for time_s in (0.0, 0.99, 1.0, 300.5)] == [0, 0, 1, 300]
    half, whole = (calibration_differences(change.rig_in(rig, stage), rig) for stage in (150, 300))
    np.testing.assert_allclose(whole["left_right_deg"], [0.0, 0.05, 0.0] * 2, atol=1e-9)
    np.testing.assert_allclose(whole["focal_percent"], 0.05, atol=1e-9)
    for name in ("left_right_deg", "focal_percent"):
        np.testing.assert_allclose(half[name], 0.5 * whole[name], atol=1e-9)
    for name in ("principal_point_px", "baseline_percent", "pair_transform_deg", "pair_transform_mm"):
        np.testing.assert_allclose(whole[name], 0.0, atol=1e-9)


def test_knock_in_the_middle_moves_the_first_pair_alone() -> None:
    rig, change = default_rig(), RIG_CHANGES["knock"]
    assert [change.stage_at(time_s, 40.0) for time_s in (0.0, 19.99, 20.0, 40.0)] == [0, 0, 1, 1]
    assert change.rig_in(rig, 0) is rig
    knocked = change.rig_in(rig, 1)
    assert knocked.pairs[1] is rig.pairs[1]
    found = calibration_differences(knocked, rig)
    assert np.linalg.norm(found["left_right_deg"]) == pytest.approx(0.1)
    assert np.linalg.norm(found["cameras_in_body_mm"]) == pytest.approx(5.0)
    np.testing.assert_allclose(found["cameras_in_body_deg"], 0.0, atol=1e-9)
    np.testing.assert_allclose(found["baseline_percent"], 0.0, atol=1e-9)


def test_knock_of_a_rig_without_pairs_moves_the_first_camera_alone() -> None:
    rig = default_rig().without_pairs()
    knocked = RIG_CHANGES["knock"].rig_in(rig, 1)
    assert all(one is other for one, other in zip(knocked.singles[1:], rig.singles[1:], strict=True))
    was, now = (each.cameras[0].body_T_cam for each in (rig, knocked))
    turn = so3_log(np.ascontiguousarray(was[:3, :3].T @ now[:3, :3]))
    assert np.rad2deg(np.linalg.norm(turn)) == pytest.approx(0.1)
    assert np.linalg.norm(now[:3, 3] - was[:3, 3]) == pytest.approx(5e-3)


# ---------------------------------------------------------------- the command


def app() -> typer.Typer:
    """The command by itself, whose errors are exceptions."""
    made = typer.Typer(pretty_exceptions_enable=False)
    made.command()(simulate_command)
    return made


def test_command_with_one_component_writes_a_rig_that_is_wrong_in_it_alone(tmp_path: Path) -> None:
    out = tmp_path / "r"
    result = CliRunner().invoke(
        app(),
        [
            *("room", "--out", str(out), "--duration", "0.1", "--rate", "10", "--rig-change", "knock"),
            *("--calibration-error", "2", "--calibration-component", "focal", "--calibration-seed", "3"),
        ],
    )
    assert result.exit_code == 0, result.output
    found = calibration_differences(load_rig(out), load_rig(out / "rig-true.yaml"))
    expected = differences(CalibrationErrorSizes.of_level(2, ["focal"]), 3)
    np.testing.assert_allclose(found["focal_percent"], expected["focal_percent"], atol=1e-9)
    np.testing.assert_allclose(found["principal_point_px"], 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--calibration-error", "5"], "level 5"),
        (["--calibration-error", "focal"], "component"),
        (["--calibration-error", "2", "--calibration-component", "lens"], "'lens'"),
        (["--rig-change", "heat"], "'heat'"),
        (["--calibration-component", "focal"], "--calibration-error"),
    ],
)
def test_command_unknown_error_is_refused(tmp_path: Path, options: list[str], message: str) -> None:
    result = CliRunner().invoke(app(), ["room", "--out", str(tmp_path / "r"), *options])
    assert result.exit_code != 0
    assert message in f"{result.output}{result.exception}"
    assert not (tmp_path / "r").exists()

"""``scripts/campaign real-imu``: NEES, NIS and biases of the smoother with a real IMU.

The recording, of EuRoC V1_01, has 145 s of a real IMU and a truth, but no images: visual motions are sampled around the
truth. The truth is reconstructed from the file's positions and the IMU, since the file's orientations are not those of
the IMU. The difference of these orientations and its effect are reported.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.report import DOCS, Report, log_progress, machine

from campaigns.consistency import NAMES
from campaigns.flight import FRAMES_HZ, Flight, Truth
from campaigns.imu_truth import Reconstruction, allan_deviation, force_errors, reconstruct, turns, with_synthetic_forces
from campaigns.measures import Squares, tilt_error
from campaigns.real_run import Miss, RealRun, real_run
from graphvio.arrays import Float
from graphvio.config.stages import SmootherConfig
from graphvio.errors import GraphvioError
from graphvio.rig import Imu

RECORDING = DOCS.parents[1] / "shared" / "data" / "euroc_v101_imu"
_FACTOR = 2.0  # aim: NEES and NIS are within this factor of their expectation
_GYRO_BIAS_AIM, _AFTER_S = 2e-3, 10
_OTHER_SCALE = 2.0
_ALLAN_S = (0.2, 0.5, 1, 2, 5, 10, 20)
_AXES = "xyz"
_OWN = ("velocity", "tilt", "gyro bias", "accel bias")  # quantities whose reconstructed truth has a covariance


def add_parser(subparsers: Subparsers) -> None:
    """Add ``real-imu``."""
    parser = add_command(subparsers, "real-imu", "NEES, NIS and biases on 145 s of a real IMU", __doc__, main)
    parser.add_argument("--seeds", type=int, default=10, help="runs with sampled errors of vision (default: 10)")
    parser.add_argument(
        "--recording",
        type=Path,
        default=RECORDING,
        metavar="DIR",
        help="EuRoC's V1_01 (default: shared/data/euroc_v101_imu next to the project)",
    )
    add_report_options(parser)


def main(args: argparse.Namespace) -> None:
    """Run and report."""
    if args.seeds < 2:
        raise GraphvioError("--seeds must be 2 or more")
    flight, imu, config = Flight.read(args.recording), Imu(), SmootherConfig()
    report = Report()
    report.add(machine(), "", f"`--seeds {args.seeds}`, {len(flight.intervals) / FRAMES_HZ:.0f} s of flight.")
    found = reconstruct(flight, imu, config.imu_noise_scale)
    _write_truth(report, flight, found, reconstruct(flight, imu, config.imu_noise_scale, rounds=1))
    truth, errors = found.truth, force_errors(flight, found.truth, imu)
    white = config.imu_noise_scale * imu.accel_noise_density
    flights = [flight] * args.seeds
    runs = _runs("default", flights, truth, config, imu)
    wider = _runs("wider", flights, truth, replace(config, imu_noise_scale=_OTHER_SCALE), imu)
    synthetic = [with_synthetic_forces(flight, errors, white, seed) for seed in range(args.seeds)]
    steady = replace(truth, accel_bias=np.tile(errors.mean(axis=0), (len(truth.accel_bias), 1)))
    _write_consistency(report, runs, found, config)
    _write_causes(report, errors, runs, wider, _runs("synthetic forces", synthetic, steady, config, imu), imu, config)
    _write_biases(report, flight.recorded, truth, runs)
    _write_recorded(report, runs[0], real_run(0, flight, flight.recorded, config, imu), flight.recorded, truth)
    report.write(args, "real-imu")


def _runs(what: str, flights: list[Flight], truth: Truth, config: SmootherConfig, imu: Imu) -> list[RealRun]:
    runs = []
    for seed, flight in enumerate(flights):
        runs.append(real_run(seed, flight, truth, config, imu))
        log_progress(f"{what}: run {seed + 1} of {len(flights)}")
    return runs


def _write_truth(report: Report, flight: Flight, found: Reconstruction, at_zero: Reconstruction) -> None:
    recorded, truth = flight.recorded, found.truth
    turned_deg = np.rad2deg(turns(recorded, truth))
    moved = np.abs(turns(at_zero.truth, truth)).max(), np.abs(at_zero.truth.accel_bias - truth.accel_bias).max()
    report.add(
        "### The truth",
        "The file and the reconstruction, by body axis. Means and, of the rotation from the file's orientations to "
        "the reconstruction's, the standard deviation, over all of the flight.",
    )
    report.table(
        ("what", *_AXES),
        [
            _by_axis("rotation, deg", turned_deg.mean(axis=0), 2),
            _by_axis("its scatter, deg", turned_deg.std(axis=0), 2),
            _by_axis("where the positions are measured, cm", 100.0 * found.lever_arm, 2),
            _by_axis("gyro bias by the file, mrad/s", 1e3 * recorded.gyro_bias.mean(axis=0), 2),
            _by_axis("gyro bias by the reconstruction, mrad/s", 1e3 * truth.gyro_bias.mean(axis=0), 2),
            _by_axis("accelerometer bias by the file, m/s^2", recorded.accel_bias.mean(axis=0), 3),
            _by_axis("accelerometer bias by the reconstruction, m/s^2", truth.accel_bias.mean(axis=0), 3),
        ],
    )
    report.add(
        f"The batch leaves a chi-square of {found.chi_square:.0f}, where {found.freedom} are expected. Its IMU is "
        "preintegrated at the biases that a first solution has found, which changes little: from that solution, "
        f"orientations by {1e3 * moved[0]:.2f} mrad at most, accelerometer biases by {1e3 * moved[1]:.1f} mm/s^2."
    )


def _write_consistency(report: Report, runs: list[RealRun], found: Reconstruction, config: SmootherConfig) -> None:
    plain, added = _squares(runs), _squares(runs, _uncertainty(found, runs))
    report.add(
        "### NEES and NIS",
        f"Means over time and {len(runs)} runs against the reconstruction, with `smoother.imu_noise_scale` "
        f"{config.imu_noise_scale:g}, the default; the aim is within a factor of {_FACTOR:g} of the number of "
        "dimensions. *Shared* is the part due to the mean error of all runs, *scattered* that due to their "
        "differences from it, both corrected for the number of runs. *With the truth's own*: the reconstruction's "
        "covariance is added to the smoother's, as if their errors were independent; the aim is for the values "
        "without it.",
    )
    table, met = [], 0
    for name, words in NAMES.items():
        dimensions, mean, scattered = plain.dimensions[name], plain.mean(name), _scattered(runs, name)
        within = 1.0 / _FACTOR <= mean / dimensions <= _FACTOR
        met += within
        table.append([
            words, *_mean(plain, name), "met" if within else "missed", f"{scattered:.2f}", f"{mean - scattered:.2f}",
            *(_mean(added, name)[1:] if name in _OWN else ("-", "-")),
        ])  # fmt: skip
    report.table(
        ("what", "dimensions", "mean", "over dimensions", "aim", "scattered", "shared", "with the truth's own",
         "over dimensions"), table,
    )  # fmt: skip
    refused, motions = sum(run.refused for run in runs), sum(len(run.gyro_biases) - 1 for run in runs)
    report.add(
        f"Aim: within a factor of {_FACTOR:g}: **{'met' if met == len(NAMES) else 'missed'}**, {met} of {len(NAMES)} "
        f"rows. The gate refused {refused} of {motions} motions, none of which was sampled as an outlier."
    )


def _write_causes(
    report: Report, errors: Float, runs: list[RealRun], wider: list[RealRun], synthetic: list[RealRun], imu: Imu,
    config: SmootherConfig,
) -> None:  # fmt: skip
    plain, other, ideal = _squares(runs), _squares(wider), _squares(synthetic)
    report.add(
        "### Causes of large values",
        f"The same runs with `smoother.imu_noise_scale` {_OTHER_SCALE:g}; and with the default on forces that are not "
        "the measured ones, but those of the reconstruction with a constant bias and the white noise of the smoother's "
        "model of the accelerometer, sampled for each run. The gyro's measurements are unchanged.",
    )
    head = ("what", "dimensions", "default", "over dimensions", f"scale {_OTHER_SCALE:g}", "over dimensions",
            "synthetic forces", "over dimensions")  # fmt: skip
    rows = [[words, *(cell for cells in (_mean(plain, name), _mean(other, name)[1:], _mean(ideal, name)[1:])
                      for cell in cells)] for name, words in NAMES.items()]  # fmt: skip
    report.table(head, rows)
    report.add(
        "Allan deviation of the measured forces less those of the reconstruction, bias included, mm/s^2, by the time "
        "over which means are taken; and that of the smoother's model of the accelerometer:",
    )
    white, walk = (config.imu_noise_scale * each for each in (imu.accel_noise_density, imu.accel_random_walk))
    table = []
    for seconds in _ALLAN_S:
        model = np.sqrt(white**2 / seconds + walk**2 * seconds / 3.0)
        deviation = allan_deviation(errors, round(seconds * FRAMES_HZ))
        table.append([*_by_axis(f"{seconds:g}", 1e3 * deviation, 1), f"{1e3 * model:.1f}"])
    report.table(("seconds", *_AXES, "model"), table)


def _write_biases(report: Report, recorded: Truth, found: Truth, runs: list[RealRun]) -> None:
    report.add(
        "### Biases",
        "Differences of the smoother's from the file's and from the reconstruction's: median and 95th percentile over "
        f"all runs and states after {_AFTER_S} s. The aim for the gyro is {1e3 * _GYRO_BIAS_AIM:g} mrad/s from the "
        "file. The file's accelerometer biases belong to its turned orientations: gravity is in them.",
    )
    first, table, beyond = _AFTER_S * FRAMES_HZ, [], np.zeros(len(recorded.gyro_bias), dtype=np.bool_)
    for axis, letter in enumerate(_AXES):
        gyro = np.array([run.gyro_biases[:, axis] for run in runs])
        beyond |= (np.abs(gyro - recorded.gyro_bias[:, axis]) > _GYRO_BIAS_AIM).any(axis=0)
        by_file, by_fit = (_apart(gyro[:, first:], each.gyro_bias[first:, axis]) for each in (recorded, found))
        results = ["met" if value <= _GYRO_BIAS_AIM else "missed" for value in by_file]
        table.append([f"gyro {letter}, mrad/s", *_pair(by_file), *results, *_pair(by_fit)])
    for axis, letter in enumerate(_AXES):
        accel = np.array([run.accel_biases[first:, axis] for run in runs])
        by_file, by_fit = (_apart(accel, each.accel_bias[first:, axis]) for each in (recorded, found))
        table.append([f"accelerometer {letter}, mm/s^2", *_pair(by_file), "-", "-", *_pair(by_fit)])
    report.table(("bias", "file: median", "95 %", "aim by median", "by 95 %", "reconstruction: median", "95 %"), table)
    sigmas = [np.sqrt(np.diag(m.covariance)) for m in runs[0].misses if (m.name, m.number) == ("gyro bias", first)]
    report.add(
        f"The last state of any run that is farther from the file's gyro biases than the aim is that at "
        f"{np.flatnonzero(beyond)[-1] / FRAMES_HZ:.0f} s. At {_AFTER_S} s the first run reports standard deviations of "
        f"{', '.join(f'{1e3 * sigma:.2f}' for sigma in sigmas[0])} mrad/s.",
    )


def _write_recorded(report: Report, run: RealRun, by_file: RealRun, recorded: Truth, found: Truth) -> None:
    report.add(
        "### With the file's own orientations",
        "One run whose vision is sampled around the file's own poses, compared with the file, and the run of the same "
        "seed on the reconstruction.",
    )
    left, right = _squares([run]), _squares([by_file])
    rows = [[words, *_mean(left, name)[:2], _mean(right, name)[1]] for name, words in NAMES.items()]
    rows.append(["motions refused by the gate", "-", str(run.refused), str(by_file.refused)])
    report.table(("what", "dimensions", "reconstruction", "file"), rows)
    means = (
        each[_AFTER_S * FRAMES_HZ :, 1].mean()
        for each in (recorded.accel_bias, found.accel_bias, run.accel_biases, by_file.accel_biases)
    )
    words = ("file", "reconstruction", "smoother on the reconstruction", "smoother on the file")
    report.add(
        "Mean accelerometer bias along y, m/s^2: "
        + ", ".join(f"{mean:.3f} ({word})" for mean, word in zip(means, words, strict=True))
        + "."
    )


def _squares(runs: list[RealRun], uncertainty: dict[tuple[str, int], Float] | None = None) -> Squares:
    """Return the squared Mahalanobis distances of all errors; ``uncertainty`` is name of the quantity and number of the
    state -> covariance of the truth, which is added to the reported one."""
    squares = Squares()
    for seed, run in enumerate(runs):
        for miss in run.misses:
            own = 0.0 if uncertainty is None else uncertainty.get((miss.name, miss.number), 0.0)
            squares.add(miss.name, seed, miss.number / FRAMES_HZ, miss.error, miss.covariance + own)
    return squares


def _uncertainty(found: Reconstruction, runs: list[RealRun]) -> dict[tuple[str, int], Float]:
    """Return the covariances of the reconstruction: name of the quantity and number of the state -> (M, M)."""
    numbers = sorted({miss.number for miss in runs[0].misses if miss.name == "velocity"})
    own: dict[tuple[str, int], Float] = {}
    for k, known in found.covariances(np.array(numbers)).items():
        pose = found.truth.world_T_body[k]
        for name, covariance in (
            ("velocity", known.velocity),
            ("tilt", tilt_error(pose, pose, known.pose)[1]),
            ("gyro bias", known.gyro_bias),
            ("accel bias", known.accel_bias),
        ):
            assert covariance is not None
            own[name, k] = covariance
    return own


def _scattered(runs: list[RealRun], name: str) -> float:
    """Return the mean squared Mahalanobis distance from the mean error of all runs, corrected for their number."""
    by_number: dict[int, list[Miss]] = defaultdict(list)
    for run in runs:
        for miss in run.misses:
            if miss.name == name:
                by_number[miss.number].append(miss)
    squares = []
    for misses in by_number.values():
        off = np.array([miss.error for miss in misses])
        off -= off.mean(axis=0)
        inverse = np.linalg.inv(np.mean([miss.covariance for miss in misses], axis=0))
        squares.append(np.einsum("si,ij,sj->", off, inverse, off) / (len(misses) - 1))
    return float(np.mean(squares))


def _mean(squares: Squares, name: str) -> tuple[str, str, str]:
    """Return cells: the number of dimensions, the mean, and the mean divided by the dimensions."""
    dimensions, mean = squares.dimensions[name], squares.mean(name)
    return str(dimensions), f"{mean:.2f}", f"{mean / dimensions:.2f}"


def _apart(found: Float, reference: Float) -> tuple[float, float]:
    """Return median and 95th percentile of the absolute differences of biases (S, N) from reference values (N,)."""
    away = np.abs(found - reference)
    return float(np.median(away)), float(np.percentile(away, 95.0))


def _pair(values: tuple[float, float]) -> list[str]:
    return [f"{1e3 * value:.2f}" for value in values]


def _by_axis(what: str, values: Float, digits: int) -> list[str]:
    return [what, *(f"{value:.{digits}f}" for value in values)]

"""The paper's model as a factor graph: with a lag of one step and one iteration it is the filter."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from paper_graph import PaperGraph
from recordings import REAL_DATA
from synthetic import random_covariance

from graphvio.arrays import Float
from graphvio.backend.ekf.filter import ExtendedKalmanFilter
from graphvio.backend.ekf.measurements import Measurement, VisualRates, accelerometer, gyro, stacked, vision
from graphvio.backend.ekf.process import noise_sigmas, propagated
from graphvio.backend.ekf.state import FilterState
from graphvio.backend.inertial import ImuBuffer
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import ImuSample
from graphvio.sources.faults import FaultLog
from graphvio.sources.tables import read_imu_csv
from graphvio.trajectory_files import load_trajectory

DT, PROBABILITY = 0.05, 0.999
SIGMAS = noise_sigmas(DT, 5.0, 10.0, 1e-3)
GYRO_SIGMA, GRAVITY_SIGMA = 0.02, 1.0
START = np.diag(np.repeat([1e-3, 0.02, 0.5, 0.5, 0.1], 3) ** 2)


@dataclass(frozen=True, eq=False)
class Step:
    """What is measured at the end of one time step."""

    rates: VisualRates
    rate: Float
    force: Float

    def expectations(self) -> list[Callable[[FilterState], Measurement]]:
        return [
            lambda state: vision(state, self.rates),
            lambda state: gyro(state, self.rate, GYRO_SIGMA),
            lambda state: accelerometer(state, self.force, GRAVITY_SIGMA),
        ]


@dataclass
class Comparison:
    """The filter and the graph on the same measurements, each with what passes the filter's gates."""

    state_error: float = 0.0
    covariance_error: float = 0.0
    updates: int = 0
    refused: int = 0

    def run(self, start: FilterState, steps: Iterator[Step]) -> None:
        running, graph = ExtendedKalmanFilter(start, START), PaperGraph(start, START)
        for step in steps:
            running.predict(DT, SIGMAS)
            graph.predict(DT, SIGMAS)
            candidates = step.expectations()
            passed = [each for each in candidates if running.gate(each(running.state), PROBABILITY).accepted]
            self.refused += len(candidates) - len(passed)
            if passed:
                running.update(stacked([each(running.state) for each in passed]))
                self.updates += 1
            for each in passed:
                graph.add(each)
            graph.update()
            self.state_error = max(self.state_error, np.abs(graph.state.minus(running.state)).max())
            sigmas = np.sqrt(np.diag(running.covariance))
            apart = np.abs(graph.covariance() - running.covariance) / np.outer(sigmas, sigmas)
            self.covariance_error = max(self.covariance_error, apart.max())


def synthetic_steps(rng: np.random.Generator, start: FilterState, count: int) -> Iterator[Step]:
    """Measurements of a random walk of the process itself, one of 30 far off."""
    state, bias = start, 0.02 * rng.standard_normal(3)
    for _ in range(count):
        noise = SIGMAS * rng.standard_normal(9)
        noise[3:6] -= 0.05 * state.rate_body  # keeps the rig from spinning up
        noise[:3] -= 0.05 * state.velocity_body
        state = state.plus(np.concatenate([np.zeros(6), noise[:6], np.zeros(3)]))
        state = propagated(state, DT)
        covariance = random_covariance(rng, 6, 0.02)
        values = np.concatenate([state.velocity_body, state.rate_body])
        values = values + np.linalg.cholesky(covariance) @ rng.standard_normal(6) + 4.0 * (rng.random() < 1 / 30)
        rate = state.rate_body + bias + GYRO_SIGMA * rng.standard_normal(3) + 2.0 * (rng.random() < 1 / 30)
        force = state.nav_R_body.T @ [0.0, 0.0, 9.81] + GRAVITY_SIGMA * rng.standard_normal(3)
        yield Step(VisualRates(values, covariance), rate, force)


def test_graph_on_synthetic_data_equals_the_filter() -> None:
    rng = np.random.default_rng(0)
    start = FilterState(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    comparison = Comparison()
    comparison.run(start, synthetic_steps(rng, start, 1000))
    assert (comparison.updates, comparison.refused > 20) == (1000, True)
    assert comparison.state_error < 1e-6
    assert comparison.covariance_error < 1e-6


@pytest.mark.skipif(not (REAL_DATA / "euroc_v101_imu").is_dir(), reason="needs ../shared/data/euroc_v101_imu")
def test_it_is_the_filter_on_a_real_imu() -> None:
    """The accelerometer of a flying machine is no measure of gravity, and now and then the gates say so."""
    rng = np.random.default_rng(0)
    steps, start = real(rng, 1000)
    comparison = Comparison()
    comparison.run(start, steps)
    assert (comparison.updates, comparison.refused > 20) == (1000, True)
    assert comparison.state_error < 1e-6
    assert comparison.covariance_error < 1e-6


def real(rng: np.random.Generator, count: int) -> tuple[Iterator[Step], FilterState]:
    """The IMU of EuRoC V1_01, and relative poses sampled around its truth, one of 30 far off; and the first state."""
    folder = REAL_DATA / "euroc_v101_imu" / "mav0"
    table = read_imu_csv(folder / "imu0" / "data.csv", FaultLog("euroc_v101_imu"))
    truth = load_trajectory(folder / "state_groundtruth_estimate0" / "data.csv")
    buffer = ImuBuffer(50.0)
    for stamp_ns, values in zip(table.stamps_ns, table.values, strict=True):
        buffer.add(ImuSample(int(stamp_ns), values[:3], values[3:]))
    begin = int(truth.stamps_ns[200]) + 20_000_000_000
    stamps = begin + np.arange(count + 1) * round(DT * 1e9)
    poses, known = truth.at(stamps, 0.1)
    assert known.all()
    covariance = np.diag(np.repeat([1e-3, 2e-3], 3) ** 2)

    def steps() -> Iterator[Step]:
        for k in range(1, count + 1):
            noise = np.sqrt(np.diag(covariance)) * rng.standard_normal(6) + 0.1 * (rng.random() < 1 / 30)
            moved = se3_inverse(poses.nav_T_body[k - 1]) @ poses.nav_T_body[k] @ se3_exp(noise)
            motion = RelativeMotion(int(stamps[k - 1]), int(stamps[k]), moved, covariance, np.zeros((6, 6)), 100)
            interval = buffer.interval(int(stamps[k - 1]), int(stamps[k]))
            assert interval is not None
            yield Step(VisualRates.of(motion), interval.mean_rate, interval.mean_force)

    first = poses.nav_T_body[0]
    return steps(), FilterState(first[:3, 3].copy(), first[:3, :3].copy(), np.zeros(3), np.zeros(3), np.zeros(3))


def test_a_longer_lag_and_more_iterations_come_nearer_to_the_batch() -> None:
    """All measurements at once, iterated to convergence, have one solution; the filter is farther from it."""
    rng = np.random.default_rng(1)
    start = FilterState(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    steps = list(synthetic_steps(rng, start, 40))
    running, candidates = ExtendedKalmanFilter(start, START), []
    for step in steps:  # what passes the filter's gates is given to all
        running.predict(DT, SIGMAS)
        passed = [each for each in step.expectations() if running.gate(each(running.state), PROBABILITY).accepted]
        running.update(stacked([each(running.state) for each in passed]))
        candidates.append(passed)
    ends = []
    for lag, iterations in ((1, 1), (10, 3), (100, 10)):
        graph = PaperGraph(start, START, lag, iterations)
        for passed in candidates:
            graph.predict(DT, SIGMAS)
            for each in passed:
                graph.add(each)
            graph.update()
        ends.append(graph.state)
    apart = [np.linalg.norm(end.minus(ends[-1])) for end in ends]
    assert apart[1] < 0.5 * apart[0]

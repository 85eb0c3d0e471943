"""Synthetic messages of a device with random delays and known truth, and the errors of its mapped clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.live.clocks import ClockMap

_BEGIN_NS = 1_700_000_000_000_000_000  # host's time
_MIN_DELAY_NS = 700_000


@dataclass(frozen=True)
class Conditions:
    """How messages come.

    Attributes:
        drift_ppm: how much faster the host's clock is than the device's.
        jitter_ms: mean of the delay beyond the least one, exponential.
        outlier_share: of messages that are delayed by ``outlier_ms`` more.
        outlier_ms: mean of it, exponential.
        rate_hz: of messages.
    """

    drift_ppm: float = 0.0
    jitter_ms: float = 2.0
    outlier_share: float = 0.01
    outlier_ms: float = 50.0
    rate_hz: float = 200.0


@dataclass(frozen=True, eq=False)
class Messages:
    """N messages in the order in which they come.

    Attributes:
        stamps_ns: (N,) by the device, which counts from its start.
        arrivals_ns: (N,) by the host, increasing.
        truth_ns: (N,) the stamps by a perfect map: the host's time, with the least delay, which cannot be estimated.
    """

    stamps_ns: Int
    arrivals_ns: Int
    truth_ns: Int


def synthetic_messages(
    conditions: Conditions, duration_s: float, rng: np.random.Generator, begin_s: float = 0.0
) -> Messages:
    """Messages from some time on; each waits for the ones before it, as in a queue."""
    count = round(duration_s * conditions.rate_hz)
    at_ns = np.round(np.arange(count) * (1e9 / conditions.rate_hz)).astype(np.int64)
    true_ns = _BEGIN_NS + round(1e9 * begin_s) + _MIN_DELAY_NS + at_ns
    stamps_ns = 5_000_000 + np.round(at_ns / (1.0 + 1e-6 * conditions.drift_ppm)).astype(np.int64)
    delay_ms = rng.exponential(conditions.jitter_ms, count)
    delay_ms += (rng.random(count) < conditions.outlier_share) * rng.exponential(conditions.outlier_ms, count)
    arrivals_ns = np.maximum.accumulate(true_ns + np.round(1e6 * delay_ms).astype(np.int64))
    return Messages(stamps_ns, arrivals_ns, true_ns)


def drift_ppm(clock: ClockMap) -> float:
    """Estimated rate of the host's clock relative to the device's, less 1."""
    return 1e6 * clock._envelope.line.drift


@dataclass(frozen=True)
class ClockErrors:
    """Errors of mapped stamps in the second after some time, over many runs.

    Attributes:
        after_s: how long the clock had been mapped.
        rms_us: of all of them.
        max_us: the largest, without its sign.
        drift_ppm: rms error of the drift then.
    """

    after_s: float
    rms_us: float
    max_us: float
    drift_ppm: float


def clock_errors(conditions: Conditions, after_s: Sequence[float], runs: int, seed: int = 0) -> list[ClockErrors]:
    """How well clocks are mapped under some conditions, after several times."""
    errors_us: list[list[Float]] = [[] for _ in after_s]
    drifts: list[list[float]] = [[] for _ in after_s]
    for run in range(runs):
        messages = synthetic_messages(conditions, max(after_s) + 1.0, np.random.default_rng([seed, run]))
        clock = ClockMap("synthetic", lambda stamp_ns, kind, detail: None)
        mapped = np.zeros(len(messages.stamps_ns))
        found = np.zeros(len(mapped))
        for k, (stamp, arrival, truth) in enumerate(
            zip(messages.stamps_ns.tolist(), messages.arrivals_ns.tolist(), messages.truth_ns.tolist(), strict=True)
        ):
            at = clock.map(stamp, arrival)
            mapped[k] = np.nan if at is None else 1e-3 * (at - truth)
            found[k] = drift_ppm(clock)
        for errors, drift, begin_s in zip(errors_us, drifts, after_s, strict=True):
            first, last = (round(s * conditions.rate_hz) for s in (begin_s, begin_s + 1.0))
            errors.append(mapped[first:last])
            drift.append(found[first] - conditions.drift_ppm)
    return [
        ClockErrors(
            after, float(np.sqrt(np.mean(np.square(e)))), float(np.abs(e).max()), float(np.sqrt(np.mean(np.square(d))))
        )
        for after, e, d in zip(after_s, errors_us, drifts, strict=True)
    ]

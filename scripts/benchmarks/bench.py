"""The runs of the accuracy benchmark: each combination of recording, configuration and pairs is run only once."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.motions import EXACT, TruthNoise
from benchmarks.report import log_progress
from benchmarks.runs import Alter, Outcome, run
from graphvio.config import Config
from graphvio.rig import Rig
from graphvio.simulation import SCENE_NAMES
from graphvio.sources import open_source

CLIP_TRUTH = TruthNoise(angle_rad=3e-4, position_m=1e-3)
"""Noise of the truth that is assumed for a real recording; about right for a laser tracker fused with an IMU."""


@dataclass
class Bench:
    """The recordings and configurations by name, and the outcomes of the runs so far."""

    recordings: dict[str, Path]
    configs: dict[str, Config]
    _rigs: dict[str, Rig] = field(default_factory=dict)
    _done: dict[tuple[str, str, tuple[int, ...], bool], Outcome] = field(default_factory=dict)

    def rig(self, recording: str) -> Rig:
        """Return the rig of a recording."""
        if recording not in self._rigs:
            self._rigs[recording] = open_source(self.recordings[recording]).rig
        return self._rigs[recording]

    def choices(self, recording: str) -> list[tuple[int, ...]]:
        """Return the combinations of pairs that are run: all pairs, then each alone."""
        count = len(self.rig(recording).pairs)
        return [tuple(range(count)), *((j,) for j in range(count) if count > 1)]

    def pair_names(self, recording: str, pairs: tuple[int, ...]) -> str:
        """Return the names of pairs."""
        return " + ".join(self.rig(recording).pairs[j].name for j in pairs)

    def better_single(self, recording: str, profile: str, imu: bool) -> tuple[str, Outcome]:
        """Return the name of the pair that, alone, has the least ATE with epochs aligned separately, and its run."""
        _, *alone = self.choices(recording)
        runs = {self.pair_names(recording, p): self.outcome(recording, profile, p, imu) for p in alone}
        best = min(runs, key=lambda name: runs[name].epoch_ate_m)
        return best, runs[best]

    def least_ate_m(self, recording: str, profile: str, imu: bool) -> float:
        """Return the least ATE of a single pair, all epochs aligned together, metres."""
        return min(self.outcome(recording, profile, pair, imu).ate_m for pair in self.choices(recording)[1:])

    @property
    def with_several_pairs(self) -> list[str]:
        """Names of the recordings with more than one pair."""
        return [name for name in self.recordings if len(self.rig(name).pairs) > 1]

    def outcome(self, recording: str, profile: str, pairs: tuple[int, ...], imu: bool) -> Outcome:
        """Return the outcome of a case, which is run when it is first asked for."""
        key = (recording, profile, pairs, imu)
        if key not in self._done:
            self._done[key] = self.special(recording, profile, self.rig(recording).with_pairs(pairs), imu)
        return self._done[key]

    def special(self, recording: str, profile: str, rig: Rig, imu: bool, alter: Alter | None = None) -> Outcome:
        """Run a recording with the given rig, and with images altered by ``alter`` if it is given."""
        used = rig if imu else rig.without_imu()
        noise = EXACT if recording in SCENE_NAMES else CLIP_TRUTH
        outcome = run(self.recordings[recording], used, self.configs[profile], alter, noise)
        pairs = " + ".join(pair.name for pair in rig.pairs)
        log_progress(
            f"  {recording}, {profile}, {pairs}, {'with' if imu else 'without'} IMU: ATE {100 * outcome.ate_m:.2f} cm"
        )
        return outcome

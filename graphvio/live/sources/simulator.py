"""The simulator as a live source: a walk that is rendered once, by another process, and then replayed there and back.

On the way back, time runs backwards: positions and attitudes are those of the way there, velocities and rates have the
opposite sign, accelerations are the same. If a walk begins and ends stationary, the whole motion is smooth.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from graphvio.errors import SourceError
from graphvio.kernel_cache import cache_root
from graphvio.live.source import DeviceInfo
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.replay import Pace, paced, speed_of
from graphvio.live.sources.simulated_faults import OPTIONS as FAULT_OPTIONS
from graphvio.live.sources.simulated_faults import DeviceFaults, devices_of, with_faults
from graphvio.live.sources.spec_options import choice_of, number_of, whole_number_of
from graphvio.measurements.readings import DeviceHealth, Reading
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.rig import Rig
from graphvio.simulation import SCENE_NAMES, build_scene
from graphvio.simulation.named_rigs import NAMED_RIGS
from graphvio.sources import Source
from graphvio.sources import open_source as open_recording
from graphvio.sources.read_ahead import read_ahead
from graphvio.sources.sequencer import merge

if TYPE_CHECKING:
    from graphvio.simulation.imu import ImuTrack

_OPTIONS = ("speed", "duration_s", "legs", "seed", "rate_hz", "recording", "rig", *FAULT_OPTIONS)
_MAX_END_SPEED_M_S = 1e-3
_log = logging.getLogger(__name__)


def list_devices() -> Sequence[DeviceInfo]:
    """See `SourceKind.list_devices`: lists the scenes that end stationary, whose walk can be repeated without end."""
    return [DeviceInfo(f"simulator:{name}", f"simulated rig, scene {name}") for name in ("room", "loop")]


def open_source(spec: SourceSpec, rig: Rig | None) -> SimulatedRig:
    """Make a source of the scene that the spec names, ``room`` by default; see `SourceKind.open_source`."""
    check_options(spec, _OPTIONS)
    scene = spec.what or "room"
    if scene not in SCENE_NAMES:
        raise SourceError(f"simulator: there is no scene {scene!r}; there are {', '.join(SCENE_NAMES)}")
    speed = speed_of(spec)
    rate_hz = number_of(spec, "rate_hz", 0.1, 200.0)
    if "drift_ppm" in spec.options and speed != 1.0:
        raise SourceError("simulator: drifting clocks are estimated from arrival times: drift_ppm needs speed=1")
    recording = Path(spec.options["recording"]) if "recording" in spec.options else None
    rig_name = choice_of(spec, "rig", tuple(NAMED_RIGS)) if "rig" in spec.options else None
    return SimulatedRig(
        scene,
        rig,
        speed,
        duration_s=number_of(spec, "duration_s", 0.1, 1e7),
        legs=whole_number_of(spec, "legs", 1, 1_000_000),
        seed=whole_number_of(spec, "seed", 0, 2**31) or 0,
        rate_hz=rate_hz,
        recording=recording,
        rig_name=rig_name,
        faults=spec.options,
    )


class SimulatedRig:
    """A simulated scene as a `LiveSource`.

    Args:
        scene: name of the scene.
        rig: a rig that replaces the scene's own, such as one with fewer pairs, or None.
        speed: factor of the scene's time, or None for as fast as readings are taken.
        duration_s: duration of the readings; None for no end.
        legs: number of walks, there and back counting as two; None for no end.
        seed: seed of all noise.
        rate_hz: framesets per second; None for the scene's own rate.
        recording: folder of `graphvio simulate` with the same scene, seed and rate; None renders the scene once, as
            much of it as the duration takes, into graphvio's folder of the user's cache.
        rig_name: name of the rig to render; None for the scene's own.
        faults: options of `DeviceFaults.parse`.
    """

    def __init__(
        self,
        scene: str,
        rig: Rig | None,
        speed: float | None,
        *,
        duration_s: float | None = None,
        legs: int | None = None,
        seed: int = 0,
        rate_hz: float | None = None,
        recording: Path | None = None,
        rig_name: str | None = None,
        faults: Mapping[str, str] | None = None,
    ) -> None:
        self.name = f"simulator-{scene}"
        self.is_realtime = speed is not None
        self._scene = scene
        self._rig = rig
        self._pace = Pace(speed)
        self._duration_s = duration_s
        self._legs = legs
        self._seed = seed
        built = build_scene(scene)
        self._rate_hz = rate_hz if rate_hz is not None else built.rate_hz
        self._folder = recording
        self._rig_name = rig_name if rig_name is not None else built.rig
        self._is_own_rig = self._rig_name == built.rig
        self._fault_options = faults or {}
        self._faults = DeviceFaults()
        self._opened: Source | None = None
        self._track: ImuTrack | None = None

    def open(self) -> Rig:
        """Render the scene, which takes minutes, unless it is in the cache, and open the recording.

        Raises:
            SourceError: if the scene cannot be rendered or walked back, or a fault is not valid.
        """
        folder = self._folder if self._folder is not None else self._rendered()
        self._opened = open_recording(folder, self._rig)
        self._track = self._inertial(self._opened)
        self._faults = DeviceFaults.parse(self._fault_options, devices_of(self._opened.rig))
        return self._opened.rig.without_stamp_offsets()  # stamps of framesets are corrected already

    def readings(self) -> Iterator[Reading]:
        """Yield samples and images when they are due."""
        assert self._opened is not None, "open() comes first"
        with closing(self._measurements(self._opened)) as measurements:
            readings = paced(measurements, self._opened.rig, self._pace)
            yield from with_faults(readings, self._opened.rig, self._faults, self._opened.start_ns, self._seed)

    def health(self) -> Sequence[DeviceHealth]:
        """Return the state of the simulated device, which is always connected."""
        return [DeviceHealth(self.name, True, "simulated")]

    def close(self) -> None:
        """End the walk."""
        self._pace.stop()

    def _measurements(self, recording: Source) -> Generator[Measurement, None, None]:
        leg = 0
        while self._legs is None or leg < self._legs:
            for measurement in _leg(recording, self._track, leg):
                if self._duration_s is not None and measurement.stamp_ns - recording.start_ns > self._duration_s * 1e9:
                    return
                yield measurement
            leg += 1

    def _inertial(self, recording: Source) -> ImuTrack | None:
        """Simulate the IMU track with its biases, which cannot be separated in the recording."""
        from graphvio.simulation.simulator import make_simulator

        if recording.rig.imu is None:
            return None
        rig = NAMED_RIGS[self._rig_name]()
        simulator = make_simulator(self._scene, seed=self._seed, rate_hz=self._rate_hz, rig=rig)
        first_ns = simulator.stamps_ns[0]
        ends_s = 1e-9 * np.array([recording.start_ns - first_ns, recording.end_ns - first_ns])
        ends = simulator.scene.motion.at(np.clip(ends_s, 0.0, simulator.scene.motion.duration_s)).velocity
        if self._legs != 1 and np.abs(ends).max() > _MAX_END_SPEED_M_S and not self._ends_early(recording):
            raise SourceError(
                f"simulator: {recording.name} does not end stationary, so that it cannot be walked back: give legs=1"
            )
        if not first_ns <= recording.start_ns <= recording.end_ns <= simulator.stamps_ns[-1]:
            raise SourceError(
                f"simulator: {recording.name} is longer than the walk of {self._scene}; give a recording of that scene"
            )
        return simulator.imu_track

    def _ends_early(self, recording: Source) -> bool:
        return self._duration_s is not None and self._duration_s * 1e9 <= recording.end_ns - recording.start_ns

    def _part_s(self) -> int | None:
        """Return how many seconds of the walk are enough for the duration; None if all of the walk is needed."""
        if self._duration_s is None:
            return None
        part_s = int(np.ceil(self._duration_s)) + 1
        return part_s if part_s < build_scene(self._scene).motion.duration_s else None

    def _rendered(self) -> Path:
        """Return the folder of the rendered scene; render it, or as much of it as is needed, if it does not exist."""
        root, part_s = cache_root().parent / "simulator", self._part_s()
        rig = "" if self._is_own_rig else f"-{self._rig_name}"
        part = "" if part_s is None else f"-{part_s}s"
        folder = root / f"{self._scene}{rig}-seed{self._seed}-{self._rate_hz:g}hz{part}-{_digest()}"
        if folder.is_dir():
            return folder
        unfinished = folder.with_name(f"{folder.name}.{os.getpid()}")
        arguments = ["simulate", self._scene, "--out", unfinished, "--seed", self._seed, "--rate", f"{self._rate_hz:g}"]
        arguments += ["--rig", self._rig_name, *([] if part_s is None else ["--duration", part_s])]
        command = [sys.executable, "-c", "from graphvio.cli import main; main()", *map(str, arguments)]
        root.mkdir(parents=True, exist_ok=True)
        try:
            _log.warning(
                "rendering %s of the simulated scene %s, once; it takes about three times its length",
                "all" if part_s is None else f"{part_s} s",
                self._scene,
            )
            if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
                raise SourceError(
                    f"simulator: {self._scene} could not be rendered; try  graphvio simulate {self._scene}"
                )
            if not folder.is_dir():  # else another process was faster
                unfinished.rename(folder)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        return folder


def _leg(recording: Source, track: ImuTrack | None, leg: int) -> Iterator[Measurement]:
    """Yield the measurements of one walk: there if the leg is even, back if it is odd; those at the turn come once."""
    start_ns, end_ns = recording.start_ns, recording.end_ns
    shift_ns, is_back = leg * (end_ns - start_ns), bool(leg % 2)
    origin_ns = end_ns if is_back else start_ns

    def restamped(stamp_ns: int) -> int:
        return start_ns + shift_ns + abs(stamp_ns - origin_ns)

    def samples() -> Iterator[ImuSample]:
        if track is None:
            return
        inside = np.flatnonzero((track.stamps_ns >= start_ns) & (track.stamps_ns <= end_ns))
        for k in inside[::-1] if is_back else inside:
            stamp_ns, rate, bias = int(track.stamps_ns[k]), track.angular_velocity[k], track.gyro_bias[k]
            if leg and stamp_ns == origin_ns:
                continue
            yield ImuSample(
                restamped(stamp_ns), 2.0 * bias - rate if is_back else rate, np.copy(track.linear_acceleration[k])
            )

    stamps = recording.stamps_ns
    ordered = (stamps[::-1] if is_back else stamps)[1 if leg else 0 :].tolist()
    with closing(read_ahead(recording.frameset_at, ordered)) as framesets:
        restamped_framesets = (FrameSet(restamped(frameset.stamp_ns), frameset.images) for frameset in framesets)
        yield from merge(samples(), restamped_framesets)


def _digest() -> str:
    """Return a digest of the simulator's files: a changed simulator renders again."""
    import graphvio.simulation

    files = sorted(Path(graphvio.simulation.__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:8]

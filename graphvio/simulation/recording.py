"""Writer of simulated recordings in the EuRoC/ASL layout, with graphvio's ``rig.yaml`` next to ``mav0``.

With a calibration error, ``rig.yaml`` has the wrong calibration, and ``rig-true.yaml`` next to it the true one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from graphvio.arrays import Float, Image
from graphvio.errors import SourceError, writing
from graphvio.geometry import quat_wxyz_from_rotation
from graphvio.rig import Rig
from graphvio.rig_files import save_rig
from graphvio.runtime import usable_cores
from graphvio.sessions import euroc_layout
from graphvio.sessions.euroc_layout import IMU_FOLDER, TRUTH_FOLDER
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.simulation.named_rigs import NAMED_RIGS
from graphvio.simulation.rig_change import RIG_CHANGES
from graphvio.simulation.scenes import build_scene
from graphvio.simulation.simulator import Simulator

TRUE_RIG_FILE = "rig-true.yaml"

Progress = Callable[[int, int], None]
"""Function that is called with the number of framesets written and their total number."""


@dataclass(frozen=True)
class SimulatedRecording:
    """Summary of a recording that was written.

    Attributes:
        path: folder that holds ``mav0`` and ``rig.yaml``.
        scene: name of the scene.
        framesets: number of instants at which cameras took an image.
        images: number of image files.
        imu_samples: number of IMU samples.
        duration_s: duration of the motion.
        path_length_m: length of the body's true path, at the stamps of the IMU.
        events: difficult moments of the scene: name -> (start, end), in seconds since the first frameset.
    """

    path: Path
    scene: str
    framesets: int
    images: int
    imu_samples: int
    duration_s: float
    path_length_m: float
    events: dict[str, tuple[float, float]]


def simulate(
    name: str,
    out: Path,
    *,
    duration_s: float | None = None,
    seed: int = 0,
    rate_hz: float | Sequence[float] | None = None,
    stationary_s: float = 1.0,
    trigger_offset_ms: float = 0.0,
    calibration_error: CalibrationErrorSizes | None = None,
    calibration_seed: int | None = None,
    rig_change: str | None = None,
    rig: Rig | None = None,
    progress: Progress | None = None,
) -> SimulatedRecording:
    """Simulate a scene and write it as a recording.

    Args:
        name: name of the scene, one of `graphvio.simulation.SCENE_NAMES`.
        out: folder to write; it must be empty or not exist.
        duration_s: duration of the recording; None for the whole walk.
        seed: seed of all noise; the same seed gives the same bytes.
        rate_hz: framesets per second; or one rate for each pair and single camera, the last one also for all after it;
            None for the scene's own rate.
        stationary_s: initial standstill; with 0 the recording begins at walking speed.
        trigger_offset_ms: delay of the triggers of each pair or single camera after those of the one before it.
        calibration_error: sizes of the errors of the camera files and of the IMU's data; the images do not depend on
            it. None for exact files and data.
        calibration_seed: seed with which the calibration error is sampled; None for ``seed``.
        rig_change: change of the true cameras during the walk, one of `graphvio.simulation.RIG_CHANGES`; the files do
            not contain it. None for no change.
        rig: true cameras and IMU; None for the scene's own rig.
        progress: called as the framesets are written.

    Raises:
        SourceError: if there is no such scene or change, a value is impossible, or the folder is not empty.
    """
    out = Path(out)
    _require_empty(out)
    if rig_change is not None and rig_change not in RIG_CHANGES:
        raise SourceError(f"there is no change {rig_change!r} of the rig; choose from {', '.join(RIG_CHANGES)}")
    scene = build_scene(name, duration_s, stationary_s)
    sampled = None
    if calibration_error is not None:
        sampled = draw(
            rig if rig is not None else NAMED_RIGS[scene.rig](),
            calibration_error,
            seed if calibration_seed is None else calibration_seed,
        )
    simulator = Simulator(
        scene,
        sampled.true_rig if sampled is not None else rig,
        seed,
        rate_hz,
        trigger_offset_ms=trigger_offset_ms,
        imu_error=sampled.imu if sampled is not None else None,
        rig_change=RIG_CHANGES[rig_change] if rig_change is not None else None,
    )
    return write_recording(simulator, out, progress, sampled.written_rig if sampled is not None else None)


def write_recording(
    simulator: Simulator, out: Path, progress: Progress | None = None, written_rig: Rig | None = None
) -> SimulatedRecording:
    """Write the recording of a simulator, with all cores.

    Args:
        simulator: the simulator.
        out: folder to write; it must be empty or not exist.
        progress: called as the framesets are written.
        written_rig: cameras and IMU as the files describe them; the true rig is then written to ``rig-true.yaml``.
            None for the true rig.

    Raises:
        SourceError: if the folder is not empty or an image cannot be written.
    """
    _require_empty(out)
    mav0 = out / "mav0"
    cameras = simulator.rig.cameras
    for camera in cameras:
        (mav0 / camera.name / "data").mkdir(parents=True)
    stamps = simulator.stamps_ns
    _write_sensors(simulator, written_rig if written_rig is not None else simulator.rig, mav0)
    _write_inertial(simulator, mav0)
    save_rig(written_rig if written_rig is not None else simulator.rig, out / "rig.yaml")
    if written_rig is not None:
        save_rig(simulator.rig, out / TRUE_RIG_FILE)

    def write(index: int) -> None:
        surfaces = simulator.surfaces(index)
        for number in (camera for group in simulator.triggered(index) for camera in simulator.cameras_of(group)):
            image = simulator.image(index, number, surfaces=surfaces)
            _write_image(mav0 / cameras[number].name / "data" / f"{stamps[index]}.png", image)

    workers = usable_cores()
    write(0)  # compiles the kernels once; threads would wait for each other
    with ThreadPoolExecutor(workers) as pool:
        for done, _ in enumerate(_in_order(pool, write, range(1, len(stamps)), 2 * workers), start=2):
            if progress is not None:
                progress(done, len(stamps))
    positions = simulator.imu_track.states.world_T_body[:, :3, 3]
    return SimulatedRecording(
        path=out,
        scene=simulator.scene.name,
        framesets=len(stamps),
        images=sum(len(group.cameras) * len(simulator.triggers_ns(j)) for j, group in enumerate(simulator.rig.groups)),
        imu_samples=len(simulator.imu_track.stamps_ns),
        duration_s=simulator.scene.motion.duration_s,
        path_length_m=float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        events=dict(simulator.scene.events),
    )


def _require_empty(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SourceError(f"{out}: is there already and not empty; give a new folder, or remove it first")


def _in_order(
    pool: ThreadPoolExecutor, work: Callable[[int], None], indices: Sequence[int], ahead: int
) -> Iterator[None]:
    """Yield each time the next index is done; at most ``ahead`` are pending, so that an interrupt takes effect soon."""
    remaining = iter(indices)
    pending: list[Future[None]] = [pool.submit(work, i) for i in islice(remaining, ahead)]
    try:
        while pending:
            yield pending.pop(0).result()
            pending += [pool.submit(work, i) for i in islice(remaining, 1)]
    finally:
        for future in pending:
            future.cancel()


def _write_image(path: Path, image: Image) -> None:
    with writing(path, SourceError, "is the disk full?"):
        euroc_layout.write_image(path, image)


def _write_sensors(simulator: Simulator, rig: Rig, mav0: Path) -> None:
    for j, camera in ((j, camera) for j, group in enumerate(rig.groups) for camera in group.cameras):
        folder = mav0 / camera.name
        text = euroc_layout.camera_yaml(camera, simulator.rates_hz[j], f"simulated {camera.name}")
        (folder / "sensor.yaml").write_text(text)
        rows = [euroc_layout.frame_row(int(stamp)) for stamp in simulator.triggers_ns(j)]
        (folder / "data.csv").write_text("\n".join([euroc_layout.FRAME_HEADER, *rows, ""]))
    for name in (IMU_FOLDER, TRUTH_FOLDER):
        (mav0 / name).mkdir()
    imu = rig.imu if rig.imu is not None else simulator.imu
    (mav0 / IMU_FOLDER / "sensor.yaml").write_text(euroc_layout.imu_yaml(imu, "simulated"))
    (mav0 / TRUTH_FOLDER / "sensor.yaml").write_text(euroc_layout.truth_yaml("exact truth of the simulation"))
    (mav0 / "body.yaml").write_text(f"comment: simulated walk, scene {simulator.scene.name}\n")


def _write_inertial(simulator: Simulator, mav0: Path) -> None:
    track = simulator.imu_track
    readings = np.hstack([track.angular_velocity, track.linear_acceleration])
    _write_table(mav0 / IMU_FOLDER / "data.csv", euroc_layout.IMU_HEADER, track.stamps_ns.tolist(), readings)
    poses = track.states.world_T_body
    quaternions = np.array([quat_wxyz_from_rotation(np.ascontiguousarray(pose[:3, :3])) for pose in poses])
    truth = np.hstack([poses[:, :3, 3], quaternions, track.states.velocity, track.gyro_bias, track.accel_bias])
    _write_table(mav0 / TRUTH_FOLDER / "data.csv", euroc_layout.STATE_HEADER, track.true_stamps_ns.tolist(), truth)


def _write_table(path: Path, header: str, stamps: Sequence[int], values: Float) -> None:
    with path.open("w") as file:
        file.write(header + "\n")
        for stamp, row in zip(stamps, values, strict=True):
            file.write(euroc_layout.rounded_row(stamp, row) + "\n")

"""``graphvio simulate``: makes a simulated recording with exact truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import completion
from graphvio.cli.json_output import publish
from graphvio.cli.shared import ends_at_interrupt, framesets_bar

if TYPE_CHECKING:
    from graphvio.rig import Rig
    from graphvio.simulation.recording import SimulatedRecording


def simulate(
    name: Annotated[
        str,
        typer.Argument(
            help="Scene: room, corridor, stairs, loop, calibration, street or flight.", autocompletion=completion.scene
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder to write; new or empty.")],
    duration: Annotated[
        float | None, typer.Option("--duration", help="Seconds of the walk.  [default: all of it]")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", help="Seed of all noise; the same seed gives the same recording, to the byte.")
    ] = 0,
    rate: Annotated[
        float | None,
        typer.Option("--rate", help="Framesets per second.  [default: 20, and 10 in the street]"),
    ] = None,
    trigger_offset_ms: Annotated[
        float, typer.Option("--trigger-offset-ms", help="Delay of each pair's trigger after that of the previous pair.")
    ] = 0.0,
    calibration_error: Annotated[
        str | None,
        typer.Option(
            "--calibration-error",
            help="Errors of the files: of a careful calibration (1), a usual one (2) or an outdated one (3).  "
            "[default: exact]",
            metavar="LEVEL",
        ),
    ] = None,
    calibration_component: Annotated[
        list[str] | None,
        typer.Option(
            "--calibration-component",
            help="Apply only this component of the error; may be repeated: focal, principal-point, distortion, "
            "left-right-rotation, baseline, cameras-in-body, pair-transform, time-offset, imu-scale, imu-misalignment "
            "or imu-noise.  [default: all]",
            metavar="NAME",
            autocompletion=completion.calibration_component,
        ),
    ] = None,
    calibration_seed: Annotated[
        int | None, typer.Option("--calibration-seed", help="Seed of the calibration error.  [default: that of --seed]")
    ] = None,
    rig_change: Annotated[
        str | None,
        typer.Option(
            "--rig-change",
            help="Change of the true cameras during the walk: thermal (slow drift) or knock (sudden, in the middle).  "
            "[default: nothing]",
            metavar="NAME",
            autocompletion=completion.rig_change,
        ),
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option(
            "--rig",
            help="Rig file; or paper, two stereo pairs, stereo, stereo+back, headset, surround, phone, car or drone.  "
            "[default: the scene's own: car in the street, drone in flight, else paper]",
            metavar="RIG",
            autocompletion=completion.named_rig,
        ),
    ] = None,
) -> None:
    """Simulate a walk, drive or flight with cameras and an IMU, and write it in the EuRoC/ASL layout.

    With --calibration-error, rig.yaml is wrong and rig-true.yaml next to it has the true rig; the images are the same.

    The corridor has a door that opens in front, a crowd, a bend with blank walls and failing lamps. The loop goes once
    around four corridors, passes its first position again, turns round and comes back past it. The street is a drive by
    car, with a stereo pair. The flight is that of a drone, 50 m over fields, and begins in the air.

    Examples:

        graphvio simulate room --out room

        graphvio simulate corridor --out corridor --duration 40 --seed 1

        graphvio simulate room --out room --calibration-error 2

        graphvio simulate room --out room --rig stereo+back

        graphvio simulate street --out street
    """
    from graphvio.simulation import CalibrationErrorSizes
    from graphvio.simulation import simulate as simulate_recording
    from graphvio.simulation.named_rigs import rig_of

    error = None
    if calibration_error is not None:
        error = CalibrationErrorSizes.of_level(calibration_error, calibration_component)
    elif calibration_component or calibration_seed is not None:
        raise typer.BadParameter("--calibration-component and --calibration-seed need --calibration-error LEVEL")
    true_rig = None
    if rig is not None:
        true_rig = rig_of(rig)
        _check_names(true_rig, rig)
    message = f"interrupted; {out} has only a part of the images: remove it"
    with ends_at_interrupt(message), framesets_bar() as bar:
        task = bar.add_task(f"rendering {name}", total=None)
        recording = simulate_recording(
            name, out, duration_s=duration, seed=seed, rate_hz=rate, trigger_offset_ms=trigger_offset_ms,
            calibration_error=error, calibration_seed=calibration_seed, rig_change=rig_change, rig=true_rig,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    _print_recording(recording)


def _check_names(rig: Rig, file: str) -> None:
    """Refuse a rig whose cameras have names that the EuRoC/ASL layout does not allow."""
    from graphvio.errors import RigError

    names = [camera.name for camera in rig.cameras]
    if "cam0" not in names or not all(name.startswith("cam") and name[3:].isdecimal() for name in names):
        raise RigError(
            f"{file}: cameras are called {', '.join(names)}; the EuRoC/ASL layout wants cam0, cam1, ...: rename them"
        )


def _print_recording(recording: SimulatedRecording) -> None:
    publish(recording)
    typer.echo(
        f"{recording.path}: {recording.framesets} framesets, {recording.images} images, "
        f"{recording.imu_samples} IMU samples, {recording.path_length_m:.1f} m in {recording.duration_s:g} s"
    )
    for event, (start, end) in recording.events.items():
        if start < recording.duration_s:
            typer.echo(f"  {event}: {start:.1f} to {min(end, recording.duration_s):.1f} s")

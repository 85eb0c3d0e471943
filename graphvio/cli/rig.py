"""``graphvio rig``: shows a calibration as graphvio reads it, and joins several calibrations to one rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graphvio.cli.json_output import publish

if TYPE_CHECKING:
    from graphvio.arrays import Float
    from graphvio.rig import Rig


def rig(
    files: Annotated[list[Path], typer.Argument(help="Calibration file or recording; several are joined.")],
    out: Annotated[Path | None, typer.Option(help="Write the rig to this rig.yaml.")] = None,
) -> None:
    """Show a calibration as graphvio reads it, join the calibrations of several pairs, and write rig.yaml.

    Pairs whose views do not overlap are calibrated one by one, for example by Kalibr: give the file of each, and first
    one with the IMU. The poses of pairs with the IMU in their file are known; those of the others are guessed, and
    `graphvio calibrate` finds them.

    Examples:

        graphvio rig camchain-imucam.yaml

        graphvio rig front-camchain-imucam.yaml back-camchain.yaml --out rig.yaml
    """
    from graphvio.errors import RigError
    from graphvio.rig_files import joined_rig, load_rig, save_rig
    from graphvio.sessions.store import is_store
    from graphvio.sources.opening import recorded_rig

    if out is not None and out.suffix not in (".yaml", ".yml"):
        raise RigError(f"{out}: is YAML; end its name in .yaml")
    if out is not None and out.exists():
        raise RigError(f"{out}: exists already; remove it, or choose another name")
    rigs = [recorded_rig(file) if is_store(file) else load_rig(file) for file in files]
    joined, guessed = joined_rig(rigs, files[0].stem if out is None else out.stem)
    found = _description(joined, guessed)
    publish(found)
    for group in found["groups"]:
        typer.echo(_group_line(group))
    typer.echo(_imu_line(joined))
    if out is not None:
        save_rig(joined, out)
        typer.echo(f"rig: {out}")
    if guessed:
        named = "rig.yaml" if out is None else out
        typer.echo(
            f"the place of {', '.join(guessed)} is not known, and guessed; find it from a recording in which the rig "
            f"turns about two axes: graphvio calibrate RECORDING --rig {named} --out rig-pairs.yaml"
        )


def _description(joined: Rig, guessed: tuple[str, ...]) -> dict[str, Any]:
    """Return a description of the rig in types that JSON has; ``guessed`` names the groups with a guessed pose."""
    from graphvio.rig import StereoPair

    return {
        "name": joined.name,
        "groups": [
            {
                "name": group.name,
                "cameras": [camera.name for camera in group.cameras],
                "models": [camera.model for camera in group.cameras],
                "sizes_px": [list(camera.size_px) for camera in group.cameras],
                "stamp_offsets_s": [camera.stamp_offset_s for camera in group.cameras],
                "baseline_m": group.baseline_m if isinstance(group, StereoPair) else None,
                "position_in_body_m": group.left.body_T_cam[:3, 3].tolist(),
                "viewing_direction_in_body": group.left.body_T_cam[:3, 2].tolist(),
                "place_is_guessed": group.name in guessed,
            }
            for group in joined.groups
        ],
        "imu": None
        if joined.imu is None
        else {"rate_hz": joined.imu.rate_hz, "time_offset_s": joined.imu.time_offset_s},
    }


def _group_line(group: dict[str, Any]) -> str:
    lenses = zip(group["sizes_px"], group["models"], strict=True)
    lens = " and ".join(dict.fromkeys(f"{width}x{height} {model}" for (width, height), model in lenses))
    pair = "single camera" if group["baseline_m"] is None else f"baseline {1e3 * group['baseline_m']:.1f} mm"
    offsets = " and ".join(dict.fromkeys(f"{1e3 * offset_s:+.2f} ms" for offset_s in group["stamp_offsets_s"]))
    return (
        f"{group['name']}: {' and '.join(group['cameras'])}, {lens}, {pair}, at "
        f"{_vector(group['position_in_body_m'])} m in body, looks along {_vector(group['viewing_direction_in_body'])}"
        + (" (guessed)" if group["place_is_guessed"] else "")
        + (f", stamps {offsets}" if any(group["stamp_offsets_s"]) else "")
    )


def _imu_line(joined: Rig) -> str:
    if joined.imu is None:
        return "no IMU"
    return f"IMU: {joined.imu.rate_hz:g} Hz, time offset {1e3 * joined.imu.time_offset_s:.2f} ms; its frame is body"


def _vector(values: list[float] | Float) -> str:
    return "(" + ", ".join(f"{round(value, 3) + 0.0:.3f}" for value in values) + ")"

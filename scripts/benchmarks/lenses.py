"""``scripts/benchmark lenses``: accuracy of lens models with the same field of view, rolling shutters and fisheyes."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from statistics import median

import numpy as np

from benchmarks.cameras import ate_mm
from benchmarks.command_line import add_report_options
from benchmarks.recordings import add_data_option, rendered_once
from benchmarks.report import Report, log_progress, machine
from graphvio.cameras import MODEL_NAMES, distort
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.rig import Camera, Rig
from graphvio.simulation import simulate
from graphvio.simulation.named_rigs import stereo
from graphvio.sources import open_source

_SIZE_PX = (320, 240)
_FIELD_OF_VIEW_DEG = 78.0
_READOUT_MS = 20.0
_FAST_RATE_HZ, _FAST_READOUT_MS, _MOVING_S = 30.0, 30.0, 4.0  # from this time on the walk turns
_PINHOLE = "pinhole"
_LENSES: Mapping[str, tuple[str, Sequence[float]]] = {
    _PINHOLE: ("radial-tangential", []),
    "radial-tangential": ("radial-tangential", [-0.283, 0.074, 1.9e-4, 1.8e-5]),
    "equidistant": ("equidistant", [0.0034, 0.0007, -0.0020, 0.0002]),
    "rational": ("rational", [0.3, -0.05, 3e-4, -2e-4, 0.01, 0.4, -0.03, 0.02]),
    "double-sphere": ("double-sphere", [-0.2, 0.6]),
    "extended-unified": ("extended-unified", [0.6, 1.1]),
    "omnidirectional": ("omnidirectional", [0.7, -0.1, 0.05, 3e-4, -2e-4]),
}
_FISHEYE = np.array([0.0034, 0.0007, -0.0020, 0.0002])
_FISHEYES = {"512x512, 154 degrees": ((512, 512), 190.0), "848x800, 170 degrees": ((848, 800), 286.0)}
"""Name, with the angle across the image -> size, and pixels per radian: like the cameras of TUM-VI and of a T265."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "lenses",
        help="accuracy by the lens model, with rolling shutters, and with wide fisheyes",
        description=f"Runs a stereo pair with IMU through the room, with images that are {_SIZE_PX[0]} pixels wide: "
        f"with each lens model at {_FIELD_OF_VIEW_DEG:g} degrees, and as high as a pinhole's view of {_SIZE_PX[1]} "
        f"pixels; with pinhole cameras whose lines are read out in {_READOUT_MS:g} ms, with and without the line time "
        f"in the rig, and in {_FAST_READOUT_MS:g} ms at {_FAST_RATE_HZ:g} Hz from a turn on; and with wide fisheyes of "
        "larger images, which see 160 degrees at most.",
        epilog="Example: scripts/benchmark lenses --seeds 1 --duration 10",
    )
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="number of recordings (default: 3)")
    parser.add_argument("--duration", type=float, default=16.0, metavar="S", help="of each walk (default: 16)")
    parser.add_argument("--lenses", nargs="*", default=list(_LENSES), choices=list(_LENSES), metavar="NAME")
    add_report_options(parser)
    add_data_option(parser)
    parser.set_defaults(run=run_all)


def run_all(args: argparse.Namespace) -> None:
    """Measure the accuracy of all lenses, and report."""
    if args.seeds < 1:
        raise GraphvioError("--seeds must be at least 1")
    if not args.duration > _MOVING_S + 1.0:
        raise GraphvioError(f"--duration must be more than {_MOVING_S + 1.0:g}: some walks begin at {_MOVING_S:g} s")
    report = Report()
    report.add(machine())
    lenses = [_PINHOLE, *(name for name in args.lenses if name != _PINHOLE)]
    ates_mm = {name: _ates_mm(args, name, rig_of(name)) for name in lenses}
    report.table(("lens", "ATE, mm, median", "worst", "over pinhole"), _rows(ates_mm, _PINHOLE))
    line_time_us = 1e3 * _READOUT_MS / (_SIZE_PX[1] - 1)
    rolling = rig_of(_PINHOLE).with_cameras(lambda camera: replace(camera, line_time_us=line_time_us))
    shutters = {
        "global": ates_mm[_PINHOLE],
        f"rolling, {_READOUT_MS:g} ms": _ates_mm(args, "rolling", rolling),
        f"rolling, {_READOUT_MS:g} ms, not in the rig": _ates_mm(args, "rolling", rolling, has_line_time=False),
    }
    report.table(("shutter", "ATE, mm, median", "worst", "over global"), _rows(shutters, "global"))
    line_time_us = 1e3 * _FAST_READOUT_MS / (_SIZE_PX[1] - 1)
    fast = rig_of(_PINHOLE).with_cameras(lambda camera: replace(camera, line_time_us=line_time_us))
    moving = partial(_ates_mm, args, rate_hz=_FAST_RATE_HZ, from_s=_MOVING_S)
    shutters = {
        "global": moving("global-fast", rig_of(_PINHOLE)),
        f"rolling, {_FAST_READOUT_MS:g} ms": moving("rolling-fast", fast),
        f"rolling, {_FAST_READOUT_MS:g} ms, without IMU": moving("rolling-fast", fast, has_imu=False),
    }
    head = (f"shutter, {_FAST_RATE_HZ:g} Hz, from {_MOVING_S:g} s on", "ATE, mm, median", "worst", "over global")
    report.table(head, _rows(shutters, "global"))
    fisheyes = {
        (name, scene): _ates_mm(args, name.split(",")[0], fisheye_rig(*lens), scene)
        for name, lens in _FISHEYES.items()
        for scene in ("room", "corridor")
    }
    rows = [(*key, f"{median(each):.2f}", f"{max(each):.2f}") for key, each in fisheyes.items()]
    report.table(("fisheyes", "scene", "ATE, mm, median", "worst"), rows)
    report.write(args, "lenses")


def rig_of(lens: str) -> Rig:
    """Return the simulator's stereo pair with other lenses, whose field of view is that of the pinhole cameras.

    The images have the same width; their height follows from the lens.
    """
    model, coefficients = _LENSES[lens]
    width, height = _SIZE_PX
    distortion = np.pad(np.array(coefficients, dtype=np.float64), (0, 8 - len(coefficients)))
    edge = np.tan(np.deg2rad(_FIELD_OF_VIEW_DEG / 2))
    x, *_ = distort(MODEL_NAMES[model], distortion, edge, 0.0)
    _, y, *_ = distort(MODEL_NAMES[model], distortion, 0.0, edge * height / width)
    focal_px = 0.5 * width / x
    height = round(2.0 * focal_px * y)
    intrinsics = np.array([focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1)])

    def change(camera: Camera) -> Camera:
        return replace(camera, model=model, distortion=distortion, intrinsics=intrinsics, size_px=(width, height))

    return stereo().with_cameras(change)


def fisheye_rig(size_px: tuple[int, int], focal_px: float) -> Rig:
    """Return the simulator's stereo pair with equidistant fisheyes."""
    (width, height), model = size_px, "equidistant"
    intrinsics = np.array([focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1)])

    def change(camera: Camera) -> Camera:
        return replace(camera, model=model, distortion=_FISHEYE, intrinsics=intrinsics, size_px=size_px)

    return stereo().with_cameras(change)


def _rows(ates_mm: Mapping[str, Sequence[float]], base: str) -> list[tuple[str, ...]]:
    return [
        (name, f"{median(each):.2f}", f"{max(each):.2f}", f"{median(each) / median(ates_mm[base]):.2f}")
        for name, each in ates_mm.items()
    ]


def _ates_mm(
    args: argparse.Namespace, name: str, rig: Rig, scene: str = "room", has_line_time: bool = True,
    has_imu: bool = True, rate_hz: float | None = None, from_s: float = 0.0,
) -> list[float]:  # fmt: skip
    found = []
    for seed in range(args.seeds):
        render = partial(simulate, scene, seed=seed, duration_s=args.duration, rate_hz=rate_hz, rig=rig)
        folder = rendered_once(args.data, scene, f"{name}-{args.duration:g}s-seed{seed}", render)
        known = open_source(folder).rig
        if not has_line_time:
            known = known.with_cameras(lambda camera: replace(camera, line_time_us=0.0))
        found.append(ate_mm(folder, known if has_imu else known.without_imu(), Config(), from_s))
        log_progress(f"{name}, {scene}, seed {seed}: {found[-1]:.2f} mm")
    return found

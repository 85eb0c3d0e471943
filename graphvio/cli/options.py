"""Arguments and options that several commands share."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from graphvio.cli import completion


def _if(is_possible: Callable[[float], bool], wanted: str) -> Callable[[float | None], float | None]:
    """Return a callback for typer that refuses impossible values of an option.

    Args:
        is_possible: returns whether a value is possible.
        wanted: possible values in words, for the error message.
    """

    def check(value: float | None) -> float | None:
        if value is not None and not is_possible(value):
            raise typer.BadParameter(f"{value:g} is not possible; give {wanted}.")
        return value

    return check


# All refuse NaN, which typer's own `min` accepts.
not_negative = _if(lambda value: value >= 0.0, "0 or more")
seconds = _if(lambda value: 0.0 <= value < math.inf, "seconds, 0 or more")
duration = _if(lambda value: value > 0.0, "seconds, more than 0")

Source = Annotated[
    Path,
    typer.Argument(
        help="Recording: a folder (EuRoC/ASL, TUM-VI, KITTI odometry or raw), a session (.mcap) or a ROS bag."
    ),
]
RigFile = Annotated[
    Path | None, typer.Option("--rig", help="Rig or calibration file.  [default: that of the recording]")
]
ConfigName = Annotated[
    str,
    typer.Option(
        "--config", help="Profile, or a YAML file with the values to change.", autocompletion=completion.profile
    ),
]
Topics = Annotated[
    str | None,
    typer.Option(
        "--topics",
        help="For sessions and bags: topics of the rig's cameras and of the IMU, such as "
        "cam0=/left/image,imu=/imu/data.  [default: by their names]",
    ),
]
Pairs = Annotated[
    str | None, typer.Option("--pairs", help="Use only these stereo pairs, such as 0 or 0,1.  [default: all]")
]
Cameras = Annotated[
    str | None,
    typer.Option(
        "--cameras",
        help="Use only these cameras, such as cam0,cam1,cam2 or 0,1,2; pairs among them stay pairs.  [default: all]",
    ),
]
NoPairs = Annotated[
    bool, typer.Option("--no-pairs", help="Use each camera as a single camera; the scale is estimated with the IMU.")
]
NoImu = Annotated[bool, typer.Option("--no-imu", help="Do not use the IMU.")]
FromS = Annotated[float | None, typer.Option("--from", help="Begin at this second of the recording.", callback=seconds)]
ToS = Annotated[float | None, typer.Option("--to", help="End at this second of the recording.", callback=seconds)]
View = Annotated[bool, typer.Option("--view", help="Show the run in the rerun viewer.")]
SaveRrd = Annotated[Path | None, typer.Option("--save-rrd", help="Save what the viewer would show; needs no display.")]
NoLoops = Annotated[bool, typer.Option("--no-loops", help="Do not search for loop closures.")]
RefineCalibration = Annotated[
    bool,
    typer.Option(
        "--refine-calibration", help="Also estimate the pairs' extrinsics and the IMU's time offset in the graph."
    ),
]
Png = Annotated[bool, typer.Option("--png", help="Pack images as PNG: smaller and slower.")]
SessionOut = Annotated[Path, typer.Option("--out", help="Session to write; a new file, .mcap.", metavar="FILE")]
LiveSource = Annotated[
    str,
    typer.Argument(
        help="KIND[:DEVICE][?OPTION=VALUE]: v4l2, realsense, oak, ros2, replay or simulator; or a recording's path.",
        autocompletion=completion.live_kind,
    ),
]
Record = Annotated[Path | None, typer.Option("--record", help="Record everything as a session, .mcap.", metavar="FILE")]
HealthPort = Annotated[
    int | None, typer.Option("--health-port", help="Answer /metrics and /healthz on this port.", min=0, max=65535)
]
Ros2Domain = Annotated[
    int | None, typer.Option("--ros2", help="Publish ROS 2 topics in this domain.", metavar="DOMAIN", min=0, max=232)
]
ForgetCalibration = Annotated[
    bool,
    typer.Option(
        "--forget-calibration", help="Use the rig file, not the calibration that earlier runs have estimated."
    ),
]
Duration = Annotated[
    float | None, typer.Option("--for", help="Stop after this many seconds.", metavar="SECONDS", callback=duration)
]
WebPort = Annotated[
    int | None,
    typer.Option(
        "--web", help="Show the run in a browser on this machine; this port and the next are used.", min=1, max=65534
    ),
]
ReportFolder = Annotated[
    Path | None, typer.Option("--report", help="Folder for a report: page, pictures, all numbers.", metavar="DIR")
]
Scale = Annotated[
    str,
    typer.Option(
        "--scale",
        help="Scale factor of the lengths that a camera measures: auto, estimate or fixed.",
        autocompletion=completion.scale_mode,
    ),
]
Seed = Annotated[
    int, typer.Option("--seed", help="Seed of all random choices; the same seed gives the same result.", min=0)
]
Times = Annotated[
    Path | None,
    typer.Option(
        "--times",
        help="File with the stamps of KITTI poses, seconds, one in each line.  [default: times.txt next to them]",
    ),
]
Verbose = Annotated[bool, typer.Option("--verbose", help="Show the traceback of an error.")]


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """Options of commands that read recordings: what is read of them, and the configuration."""

    rig: RigFile = None
    topics: Topics = None
    config: ConfigName = "default"
    pairs: Pairs = None
    cameras: Cameras = None
    no_pairs: NoPairs = False
    no_imu: NoImu = False
    from_s: FromS = None
    to_s: ToS = None


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """Options of all commands that run on live sensors."""

    rig: RigFile = None
    cameras: Cameras = None
    no_pairs: NoPairs = False
    config: ConfigName = "default"
    record: Record = None
    png: Png = False
    health_port: HealthPort = None
    duration: Duration = None
    forget_calibration: ForgetCalibration = False

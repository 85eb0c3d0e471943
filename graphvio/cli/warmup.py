"""``graphvio warmup``: compiles the numerical kernels before they are needed."""

from __future__ import annotations

from time import perf_counter

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish

_WITH_PAIRS = ("paper", "stereo+back")  # one rig of each kind, since each kind has kernels of its own
_SINGLE_CAMERAS = ("surround", "phone")


def warmup(config: options.ConfigName = "default") -> None:
    """Compile all numerical kernels for this machine in advance, such as for an image of a machine or container.

    Kernels for all kinds of rigs are compiled; without this, the first command compiles those that it needs. The
    environment variable GRAPHVIO_CACHE_DIR names the folder of the compiled kernels.

    Examples:

        graphvio warmup

        GRAPHVIO_CACHE_DIR=/opt/graphvio-kernels graphvio warmup
    """
    import numpy as np

    from graphvio.cli.warming import warm_up_visibly
    from graphvio.config import Config
    from graphvio.geometry import rotation_from_quat_wxyz
    from graphvio.kernel_cache import cache_root
    from graphvio.simulation.named_rigs import rig_of
    from graphvio.trajectory import Trajectory

    begun_s = perf_counter()
    settings = Config.load(config)
    single_cameras = _SINGLE_CAMERAS if settings.fusion.estimator == "smoother" else ()
    for name in (*_WITH_PAIRS, *single_cameras):
        warm_up_visibly(rig_of(name), settings)
    poses = Trajectory(np.array([0, 2]), np.tile(np.eye(4), (2, 1, 1)))
    poses.at(np.array([1]), max_gap_s=1.0)  # as in a comparison with a true trajectory
    rotation_from_quat_wxyz(np.array([1.0, 0.0, 0.0, 0.0]))
    taken_s = perf_counter() - begun_s
    publish({"folder": str(cache_root()), "wall_s": taken_s})
    typer.echo(f"kernels are compiled in {cache_root()} ({taken_s:.1f} s)")

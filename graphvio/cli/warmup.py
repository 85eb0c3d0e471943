"""``graphvio warmup``: compile the numerical kernels before they are needed."""

from __future__ import annotations

from time import perf_counter

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish


def warmup(config: options.ConfigName = "default") -> None:
    """Compile the numerical kernels for this machine, once: for images of machines and containers.

    The first command does so by itself. GRAPHVIO_CACHE_DIR names the folder of the compiled kernels.

    Examples:

        graphvio warmup

        GRAPHVIO_CACHE_DIR=/opt/graphvio-kernels graphvio warmup
    """
    import numpy as np

    from graphvio.cli.warming import warm_up_visibly
    from graphvio.config import Config
    from graphvio.geometry import rotation_from_quat_wxyz
    from graphvio.kernel_cache import cache_root
    from graphvio.simulation import default_rig
    from graphvio.trajectory import Trajectory

    begun_s = perf_counter()
    warm_up_visibly(default_rig(), Config.load(config))
    poses = Trajectory(np.array([0, 2]), np.tile(np.eye(4), (2, 1, 1)))
    poses.at(np.array([1]), max_gap_s=1.0)  # as a true trajectory is compared with
    rotation_from_quat_wxyz(np.array([1.0, 0.0, 0.0, 0.0]))
    taken_s = perf_counter() - begun_s
    publish({"folder": str(cache_root()), "wall_s": taken_s})
    typer.echo(f"kernels are compiled in {cache_root()} ({taken_s:.1f} s)")

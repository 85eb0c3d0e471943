"""``graphvio warmup``: compile the numerical kernels before they are needed."""

from __future__ import annotations

from time import perf_counter

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish


def warmup(config: options.ConfigName = "default", verbose: options.Verbose = False) -> None:
    """Compile the numerical kernels for this machine, once: for images of machines and containers.

    The first command does so by itself. GRAPHVIO_CACHE_DIR names the folder of the compiled kernels.

    Examples:

        graphvio warmup

        GRAPHVIO_CACHE_DIR=/opt/graphvio-kernels graphvio warmup
    """
    from graphvio.config import Config
    from graphvio.kernel_cache import cache_root
    from graphvio.simulation import default_rig
    from graphvio.warmup import warm_up

    begun_s = perf_counter()
    warm_up(default_rig(), Config.load(config))
    taken_s = perf_counter() - begun_s
    publish({"folder": str(cache_root()), "wall_s": taken_s})
    typer.echo(f"kernels are compiled in {cache_root()} ({taken_s:.1f} s)")

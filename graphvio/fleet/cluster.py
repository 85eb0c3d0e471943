"""Connection to Dask's workers: a cluster on this machine, or an existing one."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graphvio.config import Config
from graphvio.errors import FleetError, GraphvioError, importing
from graphvio.rig import Rig
from graphvio.simulation import default_rig
from graphvio.sources import open_source
from graphvio.warmup import warm_up

RETRIES = 2
WORKER_PRELOADS = ["graphvio.fleet"]
"""Modules and files with ``dask_setup`` that workers of this machine load first."""
_MAX_CONNECT_S = 20.0


def distributed() -> Any:
    """Import and return the library ``distributed``."""
    with importing("dask", "fleet", "working on many sessions"):
        import distributed
    return distributed


def default_workers() -> int:
    """Return the number of worker processes for this machine: one per two cores, and at least two.

    The odometry keeps about two cores busy, a thread for each pair and one that decodes; the other stages keep one or
    two. With two processes, one works while the other is restarted or waits for the disk.
    """
    return max(2, (os.cpu_count() or 1) // 2)


def compile_kernels(recordings: Sequence[str], rig: Rig | None, config: Config) -> None:
    """Compile the odometry's kernels in this process, before several processes would all compile the same.

    Without a rig, the rig of the first recording that can be opened here is used.
    """
    for recording in (Path(each) for each in recordings if rig is None):
        if recording.exists():
            try:
                rig = open_source(recording).rig
                break
            except GraphvioError:
                pass  # its own task reports the error
    warm_up(rig or default_rig(), config)


@contextmanager
def connected(scheduler: str | None, workers: int | None = None) -> Iterator[Any]:
    """Connect a client to the scheduler at an address, and disconnect it at the end of the context.

    Without an address, a cluster is started on this machine, and ended with the context; it has ``workers`` processes
    of one thread each.

    Raises:
        FleetError: if the scheduler cannot be reached, or the cluster cannot be started.
    """
    library = distributed()
    if scheduler is not None:
        try:
            client = library.Client(scheduler, timeout=_MAX_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise FleetError(f"{scheduler}: no Dask scheduler answers there ({error}); check the address") from None
        with client:
            yield client
        return
    import dask

    with dask.config.set({"distributed.scheduler.allowed-failures": RETRIES}):
        try:
            cluster = library.LocalCluster(
                n_workers=workers or default_workers(),
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                preload=WORKER_PRELOADS,
            )
        except (OSError, RuntimeError) as error:
            raise FleetError(f"workers cannot be started on this machine ({error})") from None
        with cluster, library.Client(cluster, set_as_default=False) as client:
            yield client

"""Run by Dask in each worker process of this machine when it starts."""

from __future__ import annotations

import logging
import signal


def dask_setup(worker: object) -> None:
    """Leave interrupts to the process that started the workers, and faults of recordings to the results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger("graphvio").setLevel(logging.ERROR)

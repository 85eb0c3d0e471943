"""Set-up of each worker process of this machine, which Dask calls."""

from __future__ import annotations

import logging

from graphvio.runtime import ignore_interrupts, use_one_opencv_thread


def dask_setup(worker: object) -> None:
    """Leave interrupts to the process that started the workers, and faults of recordings to the results."""
    ignore_interrupts()
    use_one_opencv_thread()
    logging.getLogger("graphvio").setLevel(logging.ERROR)

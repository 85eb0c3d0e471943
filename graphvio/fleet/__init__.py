"""Many sessions, each optimised by itself, in parallel on Dask's workers."""

import logging

from graphvio.runtime import ignore_interrupts, set_up_threads


def dask_setup(worker: object) -> None:
    """Set up a worker process of this machine; Dask calls it in modules that it preloads.

    Interrupts are left to the process that started the workers, and warnings on recordings to the results.
    """
    ignore_interrupts()
    set_up_threads()
    logging.getLogger("graphvio").setLevel(logging.ERROR)

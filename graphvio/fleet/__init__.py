"""Optimisation of many sessions, each by itself, in parallel on Dask's workers."""

import logging

from graphvio.runtime import ignore_interrupts, set_up_threads


def dask_setup(worker: object) -> None:
    """Set up a worker process on this machine; Dask calls it in modules that it preloads.

    Interrupts are left to the process that started the workers; warnings on recordings are not logged, as the results
    have them.
    """
    ignore_interrupts()
    set_up_threads()
    logging.getLogger("graphvio").setLevel(logging.ERROR)

"""A preload of dask's workers that extracts features in them: a process for each two places takes longer to start."""

from typing import Any

from graphvio.optimization.loops import features
from graphvio.optimization.loops.sift import SiftExtractor


def dask_setup(_: Any) -> None:
    """Extract the features, which are the same, in a worker itself, from now on."""
    setattr(features, "SiftProcess", SiftExtractor)  # noqa: B010

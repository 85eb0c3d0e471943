"""Assignment to parts of arrays, in kernels."""

from typing import Any

import numpy as np

from graphvio.kernels import kernel


@kernel
def put(target: Any, values: Any) -> None:
    """``target[:] = values`` of equal shapes, which numba takes seconds to compile each time."""
    for index in np.ndindex(values.shape):
        target[index] = values[index]

"""Type aliases of the arrays that the whole package uses."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
"""Any float64 array; docstrings give its shape."""
Image = NDArray[np.uint8]
"""A grey image, shape (height, width)."""
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
AnyArray = NDArray[Any]

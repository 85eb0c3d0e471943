"""2D-2D matching by pyramidal Lucas-Kanade, with the forward-backward check."""

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image

_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)


def track(
    source: Image,
    target: Image,
    pixels: Float,
    guess: Float,
    *,
    window_px: int,
    levels: int,
    max_forward_backward_px: float,
) -> tuple[Float, Bool]:
    """Where corners of one image are in another.

    Args:
        source: image (height, width) that holds the corners.
        target: image of the same size to find them in.
        pixels: (N, 2) corners.
        guess: (N, 2) where the search starts.
        window_px: side of the patch that is compared.
        levels: pyramid levels, 1 for the image alone.
        max_forward_backward_px: largest distance after tracking forth and back.

    Returns:
        Pixels (N, 2) and whether each was found (N,).
    """
    if len(pixels) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    options = {
        "winSize": (window_px, window_px),
        "maxLevel": levels - 1,
        "criteria": _CRITERIA,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "minEigThreshold": 1e-4,
    }
    start = np.ascontiguousarray(pixels, dtype=np.float32)
    forth, found, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        source, target, start, np.array(guess, dtype=np.float32), **options
    )
    options["maxLevel"] = 0  # the way back begins where it should end, so it needs no pyramid
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        target, source, forth, start.copy(), **options
    )
    distance = np.linalg.norm(back - start, axis=1)
    good = (found.ravel() == 1) & (found_back.ravel() == 1) & (distance <= max_forward_backward_px)
    return forth.astype(np.float64), good

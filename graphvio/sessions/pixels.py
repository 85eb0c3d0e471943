"""Converts the images in ROS messages to grey."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from graphvio.arrays import Image
from graphvio.image_decoding import ImageError, decode_grey
from graphvio.measurements.events import EventKind

_TO_GREY = {
    "bgr8": cv2.COLOR_BGR2GRAY,
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2GRAY,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2GRAY,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2GRAY,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2GRAY,
}
_CHANNELS = {"bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4}
_GREY, _GREY_16 = ("mono8", "8UC1"), ("mono16", "16UC1")


def grey(message: Any, where: str) -> Image:
    """Convert a ``sensor_msgs/Image`` or ``CompressedImage`` to grey (height, width) uint8.

    Raises:
        ImageError: if it is damaged, or its encoding is not known.
    """
    if hasattr(message, "format"):
        return decode_grey(bytes(message.data), where)
    height, width, step, encoding = message.height, message.width, message.step, message.encoding
    rows = np.asarray(message.data, dtype=np.uint8)
    if step * height > len(rows) or not height or not width:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} is cut short")
    rows = rows[: step * height].reshape(height, step)
    if encoding in _GREY_16:
        order = ">u2" if message.is_bigendian else "<u2"
        return np.ascontiguousarray(np.right_shift(rows[:, : 2 * width].copy().view(order), 8).astype(np.uint8))
    if encoding in _GREY:
        return rows[:, :width].copy()  # a view of the message could not be written to, nor compiled kernels take it
    if encoding not in _TO_GREY:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} is encoded as {encoding}, which is not known")
    channels = _CHANNELS.get(encoding, 1)
    pixels = np.ascontiguousarray(rows[:, : channels * width])
    shaped = pixels.reshape(height, width, channels) if channels > 1 else pixels
    return np.asarray(cv2.cvtColor(shaped, _TO_GREY[encoding]), dtype=np.uint8)

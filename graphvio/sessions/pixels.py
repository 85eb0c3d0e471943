"""Conversion of the images in ROS messages to grey."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from graphvio.arrays import Image
from graphvio.image_decoding import ImageError, decode_grey
from graphvio.measurements.events import EventKind

_TO_GREY = {  # all compute 0.299 R + 0.587 G + 0.114 B
    "bgr": cv2.COLOR_BGR2GRAY,
    "rgb": cv2.COLOR_RGB2GRAY,
    "bgra": cv2.COLOR_BGRA2GRAY,
    "rgba": cv2.COLOR_RGBA2GRAY,
    "bayer_rggb": cv2.COLOR_BayerRGGB2GRAY,
    "bayer_bggr": cv2.COLOR_BayerBGGR2GRAY,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2GRAY,
    "bayer_grbg": cv2.COLOR_BayerGRBG2GRAY,
}
_CHANNELS = {"bgr": 3, "rgb": 3, "bgra": 4, "rgba": 4}
_BRIGHTNESS = {  # where Y is in a row: first byte, and bytes from one to the next
    "yuv422": (1, 2), "uyvy": (1, 2), "yuv422_yuy2": (0, 2), "yuyv": (0, 2), "nv21": (0, 1), "nv24": (0, 1),
}  # fmt: skip
_SYNONYMS = {"8UC1": "mono8", "16UC1": "mono16", "8UC3": "bgr8", "8UC4": "bgra8"}  # OpenCV's order if none is named


def grey(message: Any, where: str) -> Image:
    """Convert a ``sensor_msgs/Image`` or ``CompressedImage`` to grey (height, width) uint8.

    Raises:
        ImageError: if the image is damaged, or its encoding is not known.
    """
    if hasattr(message, "format"):
        return decode_grey(bytes(message.data), where)
    height, width, step, encoding = message.height, message.width, message.step, message.encoding
    rows = np.asarray(message.data, dtype=np.uint8)
    if step * height > len(rows) or not height or not width:
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} is cut short")
    rows = rows[: step * height].reshape(height, step)
    if encoding in _BRIGHTNESS:
        first, period = _BRIGHTNESS[encoding]
        return rows[:, first::period][:, :width].copy()  # a view would be read-only, and no input for compiled kernels
    encoding = _SYNONYMS.get(encoding, encoding)
    kind, depth = encoding.rstrip("0123456789"), 2 if encoding.endswith("16") else 1
    if (kind != "mono" and kind not in _TO_GREY) or encoding not in (f"{kind}8", f"{kind}16"):
        raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} is encoded as {encoding}, which is not known")
    channels = _CHANNELS.get(kind, 1)
    pixels = rows[:, : depth * channels * width].copy()
    if depth == 2:
        pixels = np.right_shift(pixels.view(">u2" if message.is_bigendian else "<u2"), 8).astype(np.uint8)
    shaped = pixels.reshape(height, width, channels) if channels > 1 else pixels
    return pixels if kind == "mono" else np.asarray(cv2.cvtColor(shaped, _TO_GREY[kind]), dtype=np.uint8)

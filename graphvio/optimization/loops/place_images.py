"""Image files of places, named as in the database."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from graphvio.arrays import Image
from graphvio.measurements.sensors import FrameSet
from graphvio.optimization.loops.database import image_name
from graphvio.rig import Rig

# Other settings take three times as long, and hardly compress the noise of images better.
_PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION, 1,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)  # fmt: skip


def write_place(folder: Path, rig: Rig, session: str, frameset: FrameSet) -> None:
    """Write all images of a frameset as PNG files, each of which is whole or absent."""
    for j, images in frameset.images.items():
        for camera, image in zip(rig.groups[j].cameras, images, strict=True):
            path = folder / image_name(session, camera.name, frameset.stamp_ns)
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_name(f".{path.name}.tmp")  # renamed without fsync: there are thousands
            _, encoded = cv2.imencode(".png", image, _PNG_OPTIONS)
            unfinished.write_bytes(encoded.tobytes())
            unfinished.replace(path)


def read_place(folder: Path, rig: Rig, session: str, stamp_ns: int) -> FrameSet:
    """Read the images of a place, without pairs and single cameras of which a file cannot be read."""
    images = {}
    for j, group in enumerate(rig.groups):
        read = [_read(folder / image_name(session, each.name, stamp_ns), each.size_px) for each in group.cameras]
        found = tuple(image for image in read if image is not None)
        if len(found) == len(read):
            images[j] = found
    return FrameSet(stamp_ns, images)


def _read(path: Path, size_px: tuple[int, int]) -> Image | None:
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError:
        return None
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if image is None or image.shape != size_px[::-1]:
        return None
    return np.asarray(image, dtype=np.uint8)

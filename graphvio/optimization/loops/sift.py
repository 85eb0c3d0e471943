"""Extraction of SIFT features by COLMAP on the CPU, in this process or in a separate one.

pycolmap holds the interpreter's lock while it extracts, so that threads gain nothing.
"""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Float, Image
from graphvio.errors import OptimizationError
from graphvio.optimization.loops.colmap_library import CENTRE_PX, colmap

_FIRST_OCTAVE = 0  # full resolution; COLMAP's default of twice that takes three times as long
_PROGRAM = "from graphvio.optimization.loops.sift import serve; serve()"


class SiftExtractor:
    """Extracts the largest features of an image, at most ``features`` of them, in the calling thread."""

    def __init__(self, features: int) -> None:
        library = colmap()
        options = library.FeatureExtractionOptions()
        options.num_threads = 1
        options.sift.max_num_features = features
        options.sift.first_octave = _FIRST_OCTAVE
        options.sift.max_num_orientations = 1
        self._library = library
        self._extractor = library.FeatureExtractor.create(options, library.Device.cpu)

    def extract(self, image: Image) -> tuple[Float, AnyArray]:
        """Return pixels (K, 2) and descriptors (K, 128), uint8, of an image's features."""
        keypoints, descriptors = self._extractor.extract_from_uint8_array(np.ascontiguousarray(image))
        pixels = np.asarray(self._library.keypoints_to_matrix(keypoints)[:, :2], dtype=np.float64) - CENTRE_PX
        return pixels.reshape(-1, 2), np.asarray(descriptors.data, dtype=np.uint8).reshape(-1, 128)

    def close(self) -> None:
        """Do nothing; the method exists because a `SiftProcess` has to be closed."""


class SiftProcess:
    """A `SiftExtractor` in a separate process, which ends with this one at the latest; for one thread at a time."""

    def __init__(self, features: int) -> None:
        pipe = subprocess.PIPE
        self._process = subprocess.Popen([sys.executable, "-c", _PROGRAM], stdin=pipe, stdout=pipe)
        self._send(features)

    def extract(self, image: Image) -> tuple[Float, AnyArray]:
        """See `SiftExtractor`.

        Raises:
            OptimizationError: if the process has ended.
        """
        assert self._process.stdout is not None
        self._send(image)
        try:
            pixels, descriptors = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError):
            raise _ended() from None
        return pixels, descriptors

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()

    def _send(self, item: Any) -> None:
        assert self._process.stdin is not None
        try:
            pickle.dump(item, self._process.stdin, protocol=pickle.HIGHEST_PROTOCOL)
            self._process.stdin.flush()
        except (BrokenPipeError, ValueError):
            raise _ended() from None


def serve() -> None:
    """Extract features of pickled images from standard input until it ends; the features go to standard output."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that asks handles Ctrl-C
    images, features = sys.stdin.buffer, sys.stdout.buffer
    extractor = SiftExtractor(pickle.load(images))
    while True:
        try:
            image = pickle.load(images)
        except EOFError:
            return
        pickle.dump(extractor.extract(image), features, protocol=pickle.HIGHEST_PROTOCOL)
        features.flush()


def _ended() -> OptimizationError:
    return OptimizationError("the process that extracts features has ended; is there too little memory?")

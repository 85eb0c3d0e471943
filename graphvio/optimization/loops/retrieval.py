"""Which places look alike: a vocabulary of the session's own descriptors, and one vector for each image.

H. Jegou, M. Douze, C. Schmid, P. Perez, *Aggregating local descriptors into a compact image representation*, CVPR 2010
(VLAD), with the normalisations of R. Arandjelovic, A. Zisserman, *All about VLAD*, CVPR 2013.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Int

_WORDS = 64
_SAMPLE = 40_000  # descriptors that the vocabulary is made from
_ITERATIONS = 15
_FULL = 512.0  # length of COLMAP's descriptors


def vocabulary(descriptors: Sequence[AnyArray], seed: int, most: int = _WORDS) -> AnyArray:
    """Words (W, 128) that describe the descriptors (K, 128) of images best, by k-means.

    Args:
        descriptors: uint8, of N images.
        seed: of the choice of descriptors and of the first words.
        most: words.
    """
    rng = np.random.default_rng(seed)
    each = max(1, _SAMPLE // max(1, len(descriptors)))
    chosen = [rows[rng.choice(len(rows), min(each, len(rows)), replace=False)] for rows in descriptors if len(rows)]
    if not chosen:
        return np.zeros((0, 128), dtype=np.float32)
    sample = np.concatenate(chosen).astype(np.float32) / np.float32(_FULL)
    words = min(most, len(sample))
    cv2.setRNGSeed(seed)
    stop = (cv2.TERM_CRITERIA_MAX_ITER, _ITERATIONS, 0.0)
    _, _, centres = cv2.kmeans(sample, words, None, stop, 1, cv2.KMEANS_PP_CENTERS)  # type: ignore[call-overload]
    return np.asarray(centres, dtype=np.float32)


def describe(descriptors: AnyArray, words: AnyArray) -> AnyArray:
    """An image's vector (W * 128,), of length one, or zero for an image without features."""
    made = np.zeros_like(words)
    if len(descriptors) and len(words):
        rows = descriptors.astype(np.float32) / np.float32(_FULL)
        nearest = np.argmax(rows @ words.T - 0.5 * (words**2).sum(axis=1), axis=1)
        for word in range(len(words)):
            residual = (rows[nearest == word] - words[word]).sum(axis=0)
            length = np.linalg.norm(residual)
            if length > 0.0:
                made[word] = residual / length
    vector = made.ravel()
    length = np.linalg.norm(vector)
    return np.asarray(vector / length if length > 0.0 else vector)


def most_similar(
    own: AnyArray, vectors: AnyArray, starts: Int, may: Callable[[int], bool], most: int
) -> list[tuple[float, int]]:
    """The P known places that a place is most alike, by those of their images that are.

    Args:
        own: (K, D) of the place's images, of length one.
        vectors: (N, D) of the known places' images, place by place.
        starts: (P,) first row of each of them.
        may: whether it may be compared with one of these.
        most: places.

    Returns:
        Similarity and number, 0 to P - 1, the most similar first.
    """
    by_place = np.maximum.reduceat(np.max(own @ vectors.T, axis=0), starts)
    found: list[tuple[float, int]] = []
    for k in np.argsort(-by_place, kind="stable").tolist():
        if len(found) == most:
            break
        if may(k):
            found.append((float(by_place[k]), k))
    return found


def candidates(vectors: AnyArray, place: Int, may: Callable[[int, int], bool], most: int) -> list[tuple[int, int]]:
    """For each place its most similar ones among those before it: places are as alike as their images most alike.

    Args:
        vectors: (N, D) of images, of length one.
        place: (N,) number of each image's place, in order.
        may: whether an earlier and a later place may be compared.
        most: candidates of a place.

    Returns:
        Pairs (earlier, later) of places, the most similar first.
    """
    found: list[tuple[float, int, int]] = []
    numbers, starts = np.unique(place, return_index=True)
    ends = np.append(starts[1:], len(place))
    for at in range(1, len(numbers)):  # a row at a time: all of them would not fit for hours of images
        later = int(numbers[at])
        allowed = partial(lambda later, k: may(int(numbers[k]), later), later)
        own, before = vectors[starts[at] : ends[at]], vectors[: starts[at]]
        for similarity, earlier in most_similar(own, before, starts[:at], allowed, most):
            found.append((similarity, int(numbers[earlier]), later))
    found.sort(key=lambda each: (-each[0], each[1], each[2]))
    return [(earlier, later) for _, earlier, later in found]

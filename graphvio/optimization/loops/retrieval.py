"""Retrieval of similar places: a vocabulary of the sessions' own descriptors, and a VLAD vector for each image.

H. Jegou, M. Douze, C. Schmid, P. Perez, *Aggregating local descriptors into a compact image representation*, CVPR 2010
(VLAD), with the normalisations of R. Arandjelovic, A. Zisserman, *All about VLAD*, CVPR 2013.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Int

_WORDS = 64
_SAMPLE = 40_000  # number of descriptors that the vocabulary is computed from
_ITERATIONS = 15
_LENGTH = 512.0  # Euclidean length of COLMAP's descriptors


def vocabulary(descriptors: Iterable[AnyArray], images: int, seed: int, max_words: int = _WORDS) -> AnyArray:
    """Cluster descriptors into words (W, 128) by k-means.

    Args:
        descriptors: descriptors (K, 128), uint8, of each image; iterated once, as those of a recording of an hour may
            not fit in memory.
        images: number of images.
        seed: seed of the sample and of the initial words.
        max_words: number of words, if there are as many descriptors.
    """
    rng = np.random.default_rng(seed)
    each = max(1, _SAMPLE // max(1, images))
    chosen = [rows[rng.choice(len(rows), min(each, len(rows)), replace=False)] for rows in descriptors if len(rows)]
    if not chosen:
        return np.zeros((0, 128), dtype=np.float32)
    sample = np.concatenate(chosen).astype(np.float32) / np.float32(_LENGTH)
    words = min(max_words, len(sample))
    stop = (cv2.TERM_CRITERIA_MAX_ITER, _ITERATIONS, 0.0)
    labels = _initial_labels(sample, words, rng)
    _, _, centres = cv2.kmeans(sample, words, labels, stop, 1, cv2.KMEANS_USE_INITIAL_LABELS)
    return np.asarray(centres, dtype=np.float32)


def _initial_labels(sample: AnyArray, words: int, rng: np.random.Generator) -> AnyArray:
    """Choose initial words by k-means++ and return the nearest one (N, 1) of each row of a sample (N, D)."""
    nearest, labels = np.full(len(sample), np.inf), np.zeros((len(sample), 1), dtype=np.int32)
    chosen = int(rng.integers(len(sample)))
    for word in range(words):
        distances = ((sample - sample[chosen]) ** 2).sum(axis=1, dtype=np.float64)
        labels[distances < nearest] = word
        nearest = np.minimum(nearest, distances)
        total = nearest.sum()
        chosen = int(rng.choice(len(sample), p=nearest / total)) if total > 0.0 else int(rng.integers(len(sample)))
    return labels


def describe(descriptors: AnyArray, words: AnyArray) -> AnyArray:
    """Return an image's VLAD vector (W * 128,), of Euclidean length one, or zero for an image without features."""
    made = np.zeros_like(words)
    if len(descriptors) and len(words):
        rows = descriptors.astype(np.float32) / np.float32(_LENGTH)
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
    own: AnyArray, vectors: AnyArray, firsts: Int, may: Callable[[int], bool], count: int
) -> list[tuple[float, int]]:
    """Return similarity and index of the known places most similar to a place, compared by their most similar images.

    Args:
        own: vectors (K, D) of the place's images.
        vectors: vectors (N, D) of the images of P known places, place by place.
        firsts: first row (P,) of each known place in ``vectors``.
        may: returns whether a known place may be returned, given its index.
        count: maximum number of places.
    """
    by_place = np.maximum.reduceat(np.max(own @ vectors.T, axis=0), firsts)
    found: list[tuple[float, int]] = []
    for k in np.argsort(-by_place, kind="stable").tolist():
        if len(found) == count:
            break
        if may(k):
            found.append((float(by_place[k]), k))
    return found


def candidates(vectors: AnyArray, place: Int, may: Callable[[int, int], bool], count: int) -> list[tuple[int, int]]:
    """Return pairs (earlier, later) of each place and the earlier ones most similar to it, the most similar first.

    Args:
        vectors: vectors (N, D) of the images, of length one.
        place: number (N,) of each image's place, in increasing order.
        may: returns whether an earlier and a later place may be compared.
        count: maximum number of candidates per place.
    """
    found: list[tuple[float, int, int]] = []
    numbers, firsts = np.unique(place, return_index=True)
    ends = np.append(firsts[1:], len(place))
    for at in range(1, len(numbers)):  # one place at a time, as the matrix of all similarities may not fit in memory
        later = int(numbers[at])
        allowed = partial(lambda later, k: may(int(numbers[k]), later), later)
        own, before = vectors[firsts[at] : ends[at]], vectors[: firsts[at]]
        for similarity, earlier in most_similar(own, before, firsts[:at], allowed, count):
            found.append((similarity, int(numbers[earlier]), later))
    found.sort(key=lambda each: (-each[0], each[1], each[2]))
    return [(earlier, later) for _, earlier, later in found]

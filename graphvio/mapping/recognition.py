"""Retrieval of similar places by a vocabulary of visual words, which is learnt as places come."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from graphvio.arrays import AnyArray, Int
from graphvio.optimization.loops.retrieval import describe, most_similar, vocabulary

_MIN_PLACES = 8  # number of places from which the first vocabulary is learnt
_MAX_PLACES = 256  # it is learnt again whenever their number has doubled, up to this: more would not change the words


class Recognition:
    """Describes places by vectors of visual words, and finds similar ones.

    ``words`` (W, 128) is the vocabulary of an earlier map, ``learnt_from`` the number of places it was learnt from.
    """

    def __init__(self, seed: int, words: AnyArray | None = None, learnt_from: int = 0) -> None:
        self.words = np.zeros((0, 128), dtype=np.float32) if words is None else words
        self.learnt_from = learnt_from
        self._seed = seed
        self._pairs: list[list[int]] = []  # pairs that have an image at each place
        self._first_rows: list[int] = []
        self._vectors = np.zeros((0, self.words.size), dtype=np.float32)
        self._rows = 0

    def __len__(self) -> int:
        return len(self._first_rows)

    @property
    def is_due(self) -> bool:
        """Whether the vocabulary must be learnt again."""
        return len(self) >= max(_MIN_PLACES, 2 * self.learnt_from) and self.learnt_from < _MAX_PLACES

    def add(self, descriptors: Mapping[int, AnyArray]) -> None:
        """Add the next place by its descriptors: pair -> (K, 128), uint8, of the left image."""
        self.add_described(sorted(descriptors), [describe(descriptors[j], self.words) for j in sorted(descriptors)])

    def add_described(self, pairs: Sequence[int], vectors: Sequence[AnyArray]) -> None:
        """Add the next place by the vectors of its pairs' left images."""
        self._first_rows.append(self._rows)
        self._pairs.append(list(pairs))
        while self._rows + len(vectors) > len(self._vectors):
            self._vectors = np.concatenate(
                [self._vectors, np.zeros((max(64, self._rows), self.words.size), np.float32)]
            )
        for vector in vectors:
            self._vectors[self._rows] = vector
            self._rows += 1

    def learn(self, descriptors: Callable[[int, int], AnyArray]) -> None:
        """Learn the vocabulary from all places' descriptors, given by place and pair, and describe all places again."""
        images = [(place, j) for place, pairs in enumerate(self._pairs) for j in pairs]
        self.words = vocabulary((descriptors(*image) for image in images), len(images), self._seed)
        self.learnt_from = len(self)
        self._vectors = np.zeros((self._rows, self.words.size), dtype=np.float32)
        for row, image in enumerate(images):
            self._vectors[row] = describe(descriptors(*image), self.words)

    def similar(self, place: int, may: Callable[[int], bool], max_count: int) -> list[int]:
        """Return the earlier places that are most similar to a place, among those for which ``may`` returns True."""
        if not place or not self.words.size or not self._pairs[place]:
            return []
        # First rows of places without an image belong to other places.
        seen = np.array([k for k in range(place) if self._pairs[k]], dtype=np.int64)
        if not len(seen):
            return []
        first_rows = np.array(self._first_rows, dtype=np.int64)
        before = self._vectors[: first_rows[place]]
        found = most_similar(self.vectors(place), before, first_rows[seen], lambda k: may(int(seen[k])), max_count)
        return [int(seen[k]) for _, k in found]

    def pairs(self, place: int) -> Int:
        """Return the pairs (P,) of a place's images."""
        return np.array(self._pairs[place], dtype=np.int64)

    def vectors(self, place: int) -> AnyArray:
        """Return the vectors (P, D) of a place's images."""
        return self._vectors[self._first_rows[place] : self._first_rows[place] + len(self._pairs[place])]

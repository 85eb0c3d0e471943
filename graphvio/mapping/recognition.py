"""Which known places look like the one that is seen now: a vocabulary that is learnt as places come."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Int
from graphvio.optimization.loops.retrieval import describe, most_similar, vocabulary

_FIRST = 8  # places of which a vocabulary is made,
_LAST = 256  # and made anew when they have doubled, up to these: more would not change what the words are


class Recognition:
    """Images of places as vectors.

    Args:
        seed: of the vocabulary.
        words: (W, 128) of an earlier map, or none.
        learnt_from: places that these were made of.
    """

    def __init__(self, seed: int, words: AnyArray | None = None, learnt_from: int = 0) -> None:
        self.words = np.zeros((0, 128), dtype=np.float32) if words is None else words
        self.learnt_from = learnt_from
        self._seed = seed
        self._pairs: list[list[int]] = []  # of each place
        self._starts: list[int] = []
        self._vectors = np.zeros((0, self.words.size), dtype=np.float32)
        self._rows = 0

    def __len__(self) -> int:
        return len(self._starts)

    @property
    def is_due(self) -> bool:
        """Whether the vocabulary has to be learnt anew."""
        return len(self) >= max(_FIRST, 2 * self.learnt_from) and self.learnt_from < _LAST

    def add(self, descriptors: Mapping[int, AnyArray]) -> None:
        """Add the next place: pair -> descriptors (K, 128), uint8, of its left image."""
        self.add_described(sorted(descriptors), [describe(descriptors[j], self.words) for j in sorted(descriptors)])

    def add_described(self, pairs: Sequence[int], vectors: Sequence[AnyArray]) -> None:
        """Add the next place by what its images look like."""
        self._starts.append(self._rows)
        self._pairs.append(list(pairs))
        while self._rows + len(vectors) > len(self._vectors):
            self._vectors = np.concatenate(
                [self._vectors, np.zeros((max(64, self._rows), self.words.size), np.float32)]
            )
        for vector in vectors:
            self._vectors[self._rows] = vector
            self._rows += 1

    def learn(self, descriptors: Callable[[int, int], AnyArray]) -> None:
        """Make the vocabulary of all places, and describe them by it.

        Args:
            descriptors: of a place's number and pair.
        """
        images = [(place, j) for place, pairs in enumerate(self._pairs) for j in pairs]
        self.words = vocabulary(_Read(images, descriptors), self._seed)
        self.learnt_from = len(self)
        self._vectors = np.zeros((self._rows, self.words.size), dtype=np.float32)
        for row, image in enumerate(images):
            self._vectors[row] = describe(descriptors(*image), self.words)

    def similar(self, place: int, may: Callable[[int], bool], most: int) -> list[int]:
        """The places before a place that look most like it.

        Args:
            place: its number.
            may: whether it may be compared with another.
            most: places.
        """
        if not place or not self.words.size or not self._pairs[place]:
            return []
        # Starts of places without an image would be taken for others' images.
        seen = np.array([k for k in range(place) if self._pairs[k]], dtype=np.int64)
        if not len(seen):
            return []
        starts = np.array(self._starts, dtype=np.int64)
        before = self._vectors[: starts[place]]
        found = most_similar(self.vectors(place), before, starts[seen], lambda k: may(int(seen[k])), most)
        return [int(seen[k]) for _, k in found]

    def pairs(self, place: int) -> Int:
        """(P,) whose left images are known of a place."""
        return np.array(self._pairs[place], dtype=np.int64)

    def vectors(self, place: int) -> AnyArray:
        """(P, D) of these."""
        return self._vectors[self._starts[place] : self._starts[place] + len(self._pairs[place])]


class _Read(Sequence[AnyArray]):
    """Descriptors of images, read when they are asked for."""

    def __init__(self, images: Sequence[tuple[int, int]], descriptors: Callable[[int, int], AnyArray]) -> None:
        self._images = images
        self._descriptors = descriptors

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, k: Any) -> Any:
        return self._descriptors(*self._images[k])

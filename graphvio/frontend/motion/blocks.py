"""Storage of points in blocks of 32, column by column, so that loops over them become vector instructions.

A block is one flat array of rows of 32 numbers, one for each point, at constant offsets: a loop over the points of a
block then compiles to instructions that work on eight points at once.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.frontend.motion.observations import Observations
from graphvio.kernels import kernel

POINTS = 32
"""Points of a block."""


def _rows(count: int) -> tuple[int, ...]:
    return tuple(POINTS * k for k in range(count))


(
    X, Y, W,
    C00, C01, C02, C11, C12, C22,
    LEFT_U, LEFT_V, RIGHT_U, RIGHT_V,
    SEEN, SIZE,
) = _rows(15)  # fmt: skip
"""Offsets in a block: points ``[x, y, 1/Z]``, their covariances, normalised coordinates in both images, and 1 where the
right image sees a point, else 0; and the size of a block."""


class Blocks(NamedTuple):
    """Observations of N points in B blocks, each of one pair's points.

    Attributes:
        pair: (B,) index of the pair.
        first: (B,) the block's first point among all; points follow each other.
        size: (B,) number of points; the lanes beyond repeat the last one and mean nothing.
        values: (B, SIZE) the blocks, with rows at the offsets `X` to `SEEN`.
    """

    pair: Int
    first: Int
    size: Int
    values: Float


@kernel
def in_blocks(observations: Observations) -> Blocks:
    """Split observations, which are sorted by pair, into blocks."""
    pair = observations.pair
    n, blocks = len(pair), 0
    first = np.empty(n + 1, dtype=np.int64)  # more than needed
    for i in range(n):
        if i == 0 or pair[i] != pair[i - 1] or i - first[blocks - 1] == POINTS:
            first[blocks] = i
            blocks += 1
    first[blocks] = n
    values = np.empty((blocks, SIZE))
    for b in range(blocks):
        block = values[b]
        for lane in range(POINTS):
            i = min(first[b] + lane, first[b + 1] - 1)
            point, covariance = observations.points[i], observations.covariances[i]
            left, right = observations.left[i], observations.right[i]
            block[X + lane], block[Y + lane], block[W + lane] = point[0], point[1], point[2]
            block[C00 + lane], block[C01 + lane], block[C02 + lane] = (
                covariance[0, 0],
                covariance[0, 1],
                covariance[0, 2],
            )
            block[C11 + lane], block[C12 + lane], block[C22 + lane] = (
                covariance[1, 1],
                covariance[1, 2],
                covariance[2, 2],
            )
            block[LEFT_U + lane], block[LEFT_V + lane] = left[0], left[1]
            block[RIGHT_U + lane], block[RIGHT_V + lane] = right[0], right[1]
            block[SEEN + lane] = 1.0 if observations.has_right[i] else 0.0
    return Blocks(pair[first[:blocks]], first[:blocks], first[1 : blocks + 1] - first[:blocks], values)


@kernel
def point_by_point(blocks: Blocks, lanes: Float) -> Float:
    """Gather values of the blocks' lanes (B, POINTS) point by point (N,)."""
    values = np.empty(blocks.size.sum())
    for b in range(len(blocks.pair)):
        for lane in range(blocks.size[b]):
            values[blocks.first[b] + lane] = lanes[b, lane]
    return values


@kernel
def lane_by_lane(blocks: Blocks, values: Float) -> Float:
    """Scatter values of points (N,) lane by lane (B, POINTS), with zero beyond the last point of a block."""
    lanes = np.zeros((len(blocks.pair), POINTS))
    for b in range(len(blocks.pair)):
        for lane in range(blocks.size[b]):
            lanes[b, lane] = values[blocks.first[b] + lane]
    return lanes

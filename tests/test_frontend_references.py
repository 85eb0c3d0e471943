"""Which frames motions are measured from, and for how long."""

from dataclasses import replace

import numpy as np
import pytest

from graphvio.arrays import Bool, Float
from graphvio.config.stages import MotionConfig
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.motion.observations import Correspondences, correspond
from graphvio.frontend.references import References

NEAR, FAR = 0.5, 0.01  # 1/m
SIGMA_W = 0.005  # of a depth, 1/m, for pixels of 1 px: near ones are known well, far ones hardly


def frame(stamp_ns: int, inverse_depths: Float, first_id: int = 0) -> TrackedFrame:
    n = len(inverse_depths)
    covariances = np.zeros((n, 3, 3))
    covariances[:, 2, 2] = SIGMA_W**2
    return replace(
        TrackedFrame.empty(stamp_ns),
        ids=first_id + np.arange(n),
        ages=np.zeros(n, dtype=np.int64),
        pixels=np.zeros((n, 2)),
        left_rays=np.zeros((n, 2)),
        right_rays=np.zeros((n, 2)),
        right_pixels=np.zeros((n, 2)),
        points=np.column_stack([np.zeros((n, 2)), inverse_depths]),
        covariances=covariances,
        slopes=np.zeros((n, 2)),
        has_depth=np.ones(n, dtype=bool),
        frames_without_depth=np.zeros(n, dtype=np.int64),
    )


def explained(correspondences: Correspondences) -> Bool:
    return np.ones(len(correspondences.observations.pair), dtype=bool)


def spent(reference: TrackedFrame, newest: TrackedFrame) -> bool:
    references = References(MotionConfig())
    references.replace({0: reference})
    correspondences = correspond({0: reference}, {0: newest})
    return references.must_be_replaced({0: newest}, correspondences, explained(correspondences))


@pytest.mark.parametrize(("near_left", "expected"), [(30, False), (20, False), (8, True)])
def test_a_keyframe_whose_near_points_have_gone_is_spent(near_left: int, expected: bool) -> None:
    """Far points stay for long, and are most of them; they do not constrain the translation."""
    depths = np.concatenate([np.full(100, FAR), np.full(30, NEAR)])
    reference = frame(0, depths)
    assert reference.constrains_translation(0.3).sum() == 30
    assert spent(reference, reference.keep(np.arange(130) < 100 + near_left)) == expected


def test_a_keyframe_with_far_points_alone_stays() -> None:
    reference = frame(0, np.full(100, FAR))
    assert not spent(reference, reference.keep(np.arange(100) < 80))
    assert spent(reference, reference.keep(np.arange(100) < 60))  # less than the overlap


def test_of_references_at_several_instants_those_with_most_in_view_count() -> None:
    near = np.full(50, NEAR)
    references = References(MotionConfig())
    references.replace({0: frame(0, near)})
    references.replace({1: frame(5, near)})
    fresh, same = frame(9, near, first_id=1000), frame(9, near)
    assert references.shared({0: fresh, 1: same}).keys() == {1}
    assert references.shared({0: same, 1: fresh}).keys() == {0}
    assert references.shared({0: same, 1: same}).keys() == {1}  # the newer one
    references.forget(1)
    assert references.shared({0: fresh, 1: same}).keys() == {0}
    assert references.shared({1: same}) == {}
    assert references.stamps_ns == {0}

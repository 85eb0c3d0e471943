"""Observability of the cameras' relative pose, and the sentences on what is missing."""

import numpy as np
import pytest
from hand_eye import LEFT2_T_LEFT1, synthetic_pairs

from graphvio.calibration import graph, paper_method
from graphvio.calibration.observability import Observability, observe
from graphvio.geometry import se3_exp

Three = tuple[float, float, float]
ALL: Three = (0.1, 0.1, 0.1)
SOME: Three = (0.05, 0.05, 0.05)
NONE: Three = (0.0, 0.0, 0.0)
ON_THE_SPOT = (
    "the angle between the cameras about y (down) of the first left camera cannot be found; turn the rig about "
    "another axis, or move it sideways"
)


def observed(turns: Three, steps: Three, noise: float) -> Observability:
    return observe(
        synthetic_pairs(400, np.random.default_rng(0), noise, noise, turns=turns, steps=steps).pairs, LEFT2_T_LEFT1
    )


@pytest.mark.parametrize("noise", [2e-3, 1e-5])
@pytest.mark.parametrize("turns", [ALL, (0.1, 0.1, 0.0), (0.01, 0.1, 0.01)])
def test_observe_rotation_about_two_axes_is_complete(turns: Three, noise: float) -> None:
    found = observed(turns, SOME, noise)
    assert found.is_complete
    assert found.missing == ()
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[:3].max() < 0.01
    assert sigmas[3:].max() < 0.015


@pytest.mark.parametrize("noise", [2e-3, 1e-5])
def test_observe_planar_motion_leaves_offset_along_axis(noise: float) -> None:
    found = observed((0.0, 0.1, 0.0), (0.05, 0.0, 0.05), noise)
    assert len(found.undetermined) == 1
    np.testing.assert_allclose(np.abs(found.undetermined[0]), [0, 0, 0, 0, 1, 0], atol=0.02)
    (sentence,) = found.missing
    assert "rotation only about the axis y (down)" in sentence
    assert "offset along y (down) cannot be found; tilt the rig while turning" in sentence
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[4] > 1.0
    assert sigmas[[3, 5]].max() < 0.01
    assert sigmas[:3].max() < 0.02


@pytest.mark.parametrize("noise", [2e-3, 1e-5])
@pytest.mark.parametrize(
    ("turns", "steps", "undetermined", "words"),
    [
        (
            (0.0, 0.1, 0.0),
            NONE,
            2,
            [
                "offset along y (down)",
                ON_THE_SPOT,
            ],
        ),
        (NONE, SOME, 3, ["hardly turned"]),
        (NONE, (0.05, 0.0, 0.0), 4, ["hardly turned", "angle between the cameras about x (right)"]),
        (NONE, NONE, 6, ["hardly moved"]),
    ],
    ids=["on the spot", "without turning", "straight", "standstill"],
)
def test_observe_insufficient_motion_names_missing(
    turns: Three, steps: Three, undetermined: int, words: list[str], noise: float
) -> None:
    found = observed(turns, steps, noise)
    assert len(found.undetermined) == undetermined
    for expected, sentence in zip(words, found.missing, strict=True):
        assert expected in sentence


@pytest.mark.parametrize("noise", [2e-3, 1e-5])
def test_observe_translation_only_determines_rotation(noise: float) -> None:
    assert np.sqrt(np.diag(observed(NONE, SOME, noise).covariance))[:3].max() < 0.02


def test_observe_oblique_axis_is_named_by_coordinates() -> None:
    axis = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5)])
    pairs = synthetic_pairs(300, np.random.default_rng(1), turns=NONE, steps=NONE).pairs
    angles = 0.1 * np.random.default_rng(2).standard_normal(300)
    motion_1 = np.array([se3_exp(np.concatenate([angle * axis, np.zeros(3)])) for angle in angles])
    motion_2 = LEFT2_T_LEFT1 @ motion_1 @ np.linalg.inv(LEFT2_T_LEFT1)
    turned = type(pairs)(
        pairs.start_ns, pairs.end_ns, motion_1, pairs.covariance_1, np.ascontiguousarray(motion_2), pairs.covariance_2
    )
    assert "[0.00, 0.71, 0.71]" in observe(turned, LEFT2_T_LEFT1).missing[0].replace("-0.00", "0.00")


def test_observe_complete_covariance_matches_graph() -> None:
    pairs = synthetic_pairs(200, np.random.default_rng(3), 1e-3, 2e-3).pairs
    found = graph.solve(pairs, paper_method.calibrate(pairs).left2_T_left1)
    covariance = observe(pairs, found.left2_T_left1).covariance
    np.testing.assert_allclose(covariance, found.covariance, rtol=0.02, atol=1e-2 * np.abs(found.covariance).max())

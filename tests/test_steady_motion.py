"""The prediction that the last motion is repeated."""

import numpy as np
from synthetic import transform

from graphvio.frontend.tracking.steady_motion import SteadyMotion
from graphvio.measurements.motion import RelativeMotion


def test_predictions_without_a_measurement_for_long_are_the_last_motion() -> None:
    """Five hundred framesets: had each step been the difference of two poses, rounding would have doubled with each."""
    step, steady = transform([0.01, -0.02, 0.03], [0.1, 0.0, 0.02]), SteadyMotion()
    measured = RelativeMotion(0, 1, step, np.eye(6), np.eye(6), 50)
    for stamp_ns in range(500):
        steady.begin(stamp_ns)
        steady.end(measured if stamp_ns == 1 else None)
    steady.begin(500)
    now_T_then = steady.predict(499)
    assert now_T_then is not None
    np.testing.assert_allclose(now_T_then @ step, np.eye(4), atol=1e-9)

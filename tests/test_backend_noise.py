"""Noise models keep all of a covariance."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import random_covariance

from graphvio.backend.noise import gaussian


@pytest.mark.parametrize("sigma", [1.0, 1e-3, 1e-5, 1e-7])
def test_correlations_are_kept_however_small_the_covariance(sigma: float) -> None:
    covariance = random_covariance(np.random.default_rng(0), 6, sigma)
    np.testing.assert_allclose(
        gaussian(covariance).covariance() / sigma**2, covariance / sigma**2, rtol=1e-8, atol=1e-8
    )

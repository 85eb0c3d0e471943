"""Small symmetric matrices: eigenvectors, Mahalanobis lengths, and results that are the same to the bit everywhere."""

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from monte_carlo import Conditions, arrays_of_walks, sample_frame

from graphvio.arrays import AnyArray, Float
from graphvio.backend.gating import gate_innovation
from graphvio.backend.noise import own_covariance
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.refinement import refine
from graphvio.frontend.pairs.agreement import disagreement
from graphvio.linear_algebra import eigen, product, squared_length

PLACES = range(0, 64, 8)  # bytes from a cache line's beginning


def at_place(array: AnyArray, place: int) -> AnyArray:
    """A copy that begins so many bytes after the beginning of a cache line."""
    memory = np.empty(array.nbytes + 128, dtype=np.uint8)
    begin = -memory.ctypes.data % 64 + place
    copy = memory[begin : begin + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def results_at(place: int, truth: Float, seen: Observations, rig: RigArrays) -> str:
    """The bytes of a motion's covariances and of two tests with them, all inputs being at some place in memory."""
    seen = Observations(*(at_place(column, place) for column in seen))
    rig = RigArrays(*(at_place(column, place) for column in rig))
    refined = refine(rig, seen, at_place(truth, place), MotionConfig())
    covariance, shared = at_place(refined.covariance, place), at_place(refined.shared_covariance, place)
    other = replace(refined, covariance=covariance)
    tested = [disagreement(refined, other), gate_innovation(at_place(np.arange(6.0), place), covariance, 0.9).statistic]
    parts = (refined.cur_T_ref, covariance, shared, own_covariance(covariance, shared), np.array(tested))
    return "".join(part.tobytes().hex() for part in parts)


def test_motion_is_the_same_wherever_its_inputs_lie_and_whatever_blas_does(tmp_path: Path) -> None:
    """OpenBLAS's code differs by processor and threads, and for some by where an array lies: it must not take part."""
    inputs = (*sample_frame(Conditions(per_pair=(60, 57)), np.random.default_rng(1)), arrays_of_walks())
    (tmp_path / "inputs").write_bytes(pickle.dumps(inputs))
    program = (
        "import pickle, sys, test_linear_algebra as t; inputs = pickle.load(open(sys.argv[1], 'rb'));"
        "print(*{t.results_at(place, *inputs) for place in t.PLACES})"
    )
    found = {results_at(place, *inputs) for place in PLACES}
    for processor in ("Haswell", "Prescott"):
        done = subprocess.run(
            [sys.executable, "-c", program, tmp_path / "inputs"], cwd=Path(__file__).parent, capture_output=True,
            text=True, check=True,
            env={**os.environ, "OPENBLAS_CORETYPE": processor, "OPENBLAS_NUM_THREADS": "2"},
        )  # fmt: skip
        found |= set(done.stdout.split())
    assert len(found) == 1


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
def test_eigen_diagonalises(scale: float) -> None:
    rng = np.random.default_rng(2)
    for size in (1, 2, 3, 6, 9):
        root = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-4.0, 4.0, size)
        matrix = scale * root @ root.T
        values, axes = eigen(matrix)
        np.testing.assert_allclose(axes.T @ axes, np.eye(size), atol=1e-13)
        np.testing.assert_allclose((axes * values) @ axes.T, matrix, atol=1e-14 * np.abs(matrix).max() * size)
        np.testing.assert_allclose(np.sort(values)[-1], np.linalg.eigvalsh(matrix)[-1], rtol=1e-12)


def test_eigen_of_a_matrix_that_is_not_finite_raises() -> None:
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        eigen(np.full((3, 3), np.nan))


def test_product_and_squared_length_are_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    a, b, v = rng.normal(size=(4, 6)), rng.normal(size=(6, 5)), rng.normal(size=6)
    np.testing.assert_allclose(product(a, b), a @ b, rtol=1e-12)
    covariance = b @ b.T + np.eye(6)
    np.testing.assert_allclose(squared_length(v, covariance), v @ np.linalg.solve(covariance, v), rtol=1e-12)
    assert np.isnan(squared_length(v, -covariance))

"""COLMAP's database of places, if some pairs are missing at the first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recordings import small_rig

pytest.importorskip("pycolmap")

from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.features import PairFeatures, store_place


def shown(seed: int) -> PairFeatures:
    rng = np.random.default_rng(seed)
    left, descriptors = rng.uniform(5.0, 40.0, (7, 2)), rng.integers(0, 256, (7, 128)).astype(np.uint8)
    return PairFeatures(left, descriptors, rng.uniform(5.0, 40.0, (3, 2)), np.array([0, 2, 5]))


@pytest.mark.parametrize("first", [0, 1])
def test_store_place_first_place_of_one_pair(tmp_path: Path, first: int) -> None:
    rig = small_rig(2)
    with FeatureDatabase(tmp_path / "features.db") as database:
        for session in ("before", "walk"):  # another session's cameras have numbers of their own
            store_place(database, rig, session, 1, {first: shown(first)})
            store_place(database, rig, session, 2, {0: shown(2), 1: shown(3)})
            known = database.rig_of(session, rig)
            assert known is not None
            assert list(known[1]) == [camera.name for camera in rig.cameras]
    with FeatureDatabase(tmp_path / "features.db") as database:
        again = database.rig_of("walk", rig)
        assert again == known
        assert database.rig_of("nobody's", rig) is None
        left = image_name("walk", rig.pairs[1].left.name, 2)
        np.testing.assert_allclose(database.pixels(left), shown(3).left, atol=1e-4)
        right = image_name("walk", rig.pairs[1].right.name, 2)
        np.testing.assert_array_equal(database.matches(left, right)[:, 0], [0, 2, 5])

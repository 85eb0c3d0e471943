"""Verification of the matches between places by the optimised poses, for COLMAP's triangulation.

Matches between places that are neighbours in time, and between the places of used loop closures, are verified if they
agree with the epipolar geometry of the optimised poses. All other matches stay in the database unverified, and COLMAP
does not triangulate them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.geometry import se3_inverse
from graphvio.optimization.loops.closures import Place
from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.matching import alike, known_geometry
from graphvio.optimization.loops.search import SessionInput
from graphvio.optimization.optimize import Optimization
from graphvio.rig import Camera
from graphvio.sources.read_ahead import read_ahead

_NEIGHBOURS = 2  # number of following places that each place is matched with
_EPIPOLAR_PX = 4.0  # COLMAP's limit for two views
_MIN_MATCHES = 15  # between two images; COLMAP ignores pairs with fewer


@dataclass(frozen=True, eq=False)
class _ImagePair:
    """Two images to match: left images, or single cameras' images, of two places."""

    names: tuple[str, str]
    cameras: tuple[Camera, Camera]
    second_T_first: Float


def verify_matches(
    optimization: Optimization,
    sessions: Sequence[SessionInput],
    database: FeatureDatabase,
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> None:
    """Match neighbouring places that were not matched before, and verify all matches by the optimised poses."""
    pairs = {each.names: each for each in _neighbours(optimization, sessions, database)}
    pairs |= {each.names: each for each in _loops(optimization, sessions, database)}
    lefts = {
        image_name(session.name, group.left.name, place.stamp_ns)
        for session in sessions
        for place in session.places
        for group in session.rig.groups
    }
    with database.transaction():
        for first, second in database.verified_pairs():
            if first in lefts and second in lefts:
                database.verify(first, second, None)
    listed = sorted(pairs.values(), key=lambda each: each.names)
    read = (_stored(pair, database) for pair in listed)
    verified = read_ahead(lambda stored: _verified(*stored), read, depth=4)
    for done, (pair, (rows, is_new, geometry)) in enumerate(zip(listed, verified, strict=True), start=1):
        with database.transaction():
            if is_new:
                database.add_matches(*pair.names, rows)
            database.verify(*pair.names, geometry if len(geometry.inlier_matches) >= _MIN_MATCHES else None)
        on_progress(done, len(listed))


def _stored(
    pair: _ImagePair, database: FeatureDatabase
) -> tuple[_ImagePair, tuple[Float, Float], Int | None, list[AnyArray]]:
    """Return an image pair with its features' pixels and stored matches; without these, None and the descriptors."""
    pixels = (database.pixels(pair.names[0]), database.pixels(pair.names[1]))
    if database.has_matches(*pair.names):
        return pair, pixels, database.all_matches(*pair.names), []
    return pair, pixels, None, [database.descriptors(name) for name in pair.names]


def _verified(
    pair: _ImagePair, pixels: tuple[Float, Float], matches: Int | None, descriptors: list[AnyArray]
) -> tuple[Int, bool, Any]:
    """Return matches (M, 2), whether they are new, and the geometry that verifies them."""
    rows = alike(*descriptors) if matches is None else matches
    geometry = known_geometry(pair.cameras, pair.second_T_first, pixels, rows, _EPIPOLAR_PX)
    return rows, matches is None, geometry


def _neighbours(
    optimization: Optimization, sessions: Sequence[SessionInput], database: FeatureDatabase
) -> Iterator[_ImagePair]:
    for number, session in enumerate(sessions):
        frame = optimization.sessions[number].frame
        for k, place in enumerate(session.places):
            for other in session.places[k + 1 : k + 1 + _NEIGHBOURS]:
                if frame[place.row] != frame[other.row]:
                    continue
                for j in range(len(session.rig.groups)):
                    pair = _image_pair(optimization, sessions, (place, other), (j, j))
                    if database.names.issuperset(pair.names):
                        yield pair


def _loops(
    optimization: Optimization, sessions: Sequence[SessionInput], database: FeatureDatabase
) -> Iterator[_ImagePair]:
    """Yield the image pairs that the loop search matched, of the loop closures that are used."""
    for loop in optimization.loops:
        if loop.refusal:
            continue
        places = (loop.closure.reference, loop.closure.current)
        for a in range(len(sessions[places[0].session].rig.groups)):
            for b in range(len(sessions[places[1].session].rig.groups)):
                pair = _image_pair(optimization, sessions, places, (a, b))
                if database.names.issuperset(pair.names) and database.has_matches(*pair.names):
                    yield pair


def _image_pair(
    optimization: Optimization, sessions: Sequence[SessionInput], places: tuple[Place, Place], groups: tuple[int, int]
) -> _ImagePair:
    of = [sessions[place.session] for place in places]
    first, second = (session.rig.groups[j].left for session, j in zip(of, groups, strict=True))
    names = [image_name(s.name, c.name, p.stamp_ns) for s, c, p in zip(of, (first, second), places, strict=True)]
    nav_T_one, nav_T_other = (optimization.sessions[p.session].nav_T_body[p.row] for p in places)
    second_T_first = second.cam_T_body @ se3_inverse(nav_T_other) @ nav_T_one @ first.body_T_cam
    return _ImagePair((names[0], names[1]), (first, second), np.ascontiguousarray(second_T_first))

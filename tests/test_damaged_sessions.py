"""Damaged sessions: losses are counted, and all other measurements are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recordings import write_euroc
from test_sessions import same
from typer.testing import CliRunner

from graphvio import FrameSet, ImuSample, open_source
from graphvio.cli import app
from graphvio.errors import GraphvioError, SessionError
from graphvio.sessions.mcap_storage import McapStorage
from graphvio.sessions.store import open_store
from graphvio.sessions.writer import SessionWriter

pytest.importorskip("mcap")
pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("damaged") / "walk", frames=8, pairs=1)


@pytest.fixture(scope="module")
def session(recording: Path) -> Path:
    """A session with many chunks, some with images and samples."""
    path = recording.parent / "walk.mcap"
    source = open_source(recording)
    with SessionWriter(path, source.rig) as writer:
        assert isinstance(writer._storage, McapStorage)
        for number, measurement in enumerate(source):
            writer._storage._last_flush_s = -1.0 if number % 20 == 0 else np.inf
            writer.add(measurement)
    return path


def chunks(path: Path) -> list[int]:
    """Bytes at which chunks begin."""
    file = open_store(path)
    return sorted({place.chunk for topic in file.topics.values() for place in topic.places})


def changed(path: Path, to: Path, at: int, bit: int = 1) -> Path:
    data = bytearray(path.read_bytes())
    data[at] ^= bit
    to.write_bytes(data)
    return to


def places_of(path: Path, topic: str, chunk: int) -> list[int]:
    return [place.logged_ns for place in open_store(path).topics[topic].places if place.chunk == chunk]


@pytest.mark.parametrize("which", [0, 6, -1])
def test_damaged_chunk_is_left_out_and_counted(session: Path, tmp_path: Path, which: int) -> None:
    """Without the first chunk, channels are known from the summary only."""
    chunk = chunks(session)[which]
    length = int.from_bytes(session.read_bytes()[chunk + 1 : chunk + 9], "little")
    path = changed(session, tmp_path / "walk.mcap", chunk + 9 + length - 5)
    samples, images = places_of(session, "/imu", chunk), places_of(session, "/pair0/left/image_raw", chunk)
    source = open_source(path)
    measurements, expected = (
        list(source),
        [measurement for measurement in open_source(session) if measurement.stamp_ns not in samples],
    )
    if not images:
        assert source.faults.counts["imu_garbage"] == len(samples) > 0
    else:
        assert source.faults.counts["image_undecodable"] == 2 * len(images)
        expected = [e for e in expected if not (isinstance(e, FrameSet) and e.stamp_ns in images)]
    key = lambda measurement: (measurement.stamp_ns, isinstance(measurement, FrameSet))  # noqa: E731
    assert len(measurements) == len(expected) > 100
    for one, other in zip(sorted(measurements, key=key), sorted(expected, key=key), strict=True):
        same(one, other)


def test_zero_checksum_is_not_verified(session: Path, tmp_path: Path) -> None:
    data = bytearray(session.read_bytes())
    for chunk in chunks(session):
        data[chunk + 9 + 24 : chunk + 9 + 28] = bytes(4)
    (tmp_path / "walk.mcap").write_bytes(data)
    source = open_source(tmp_path / "walk.mcap")
    assert len(list(source)) == len(list(open_source(session)))
    assert not source.faults.counts


def test_damaged_rig_is_refused_unless_another_is_given(session: Path, tmp_path: Path) -> None:
    at = session.read_bytes().index(b"intrinsics")
    path = changed(session, tmp_path / "walk.mcap", at + 14)
    with pytest.raises(SessionError, match="the rig in it is damaged"):
        open_source(path)
    source = open_source(path, open_source(session).rig)
    assert len(list(source)) == len(list(open_source(session)))
    assert source.faults.counts == {"session_damaged": 1}


def test_wrong_stamp_in_the_index_is_detected(session: Path, tmp_path: Path) -> None:
    file = open_store(session)
    place = file.topics["/pair0/left/image_raw"].places[3]
    entry = place.logged_ns.to_bytes(8, "little") + place.offset.to_bytes(8, "little")
    path = changed(session, tmp_path / "walk.mcap", session.read_bytes().index(entry, place.chunk))
    source = open_source(path)
    assert len([measurement for measurement in source if isinstance(measurement, FrameSet)]) == 7
    assert source.faults.counts["image_undecodable"] == 1


def test_record_of_a_damaged_session_goes_on(session: Path, tmp_path: Path) -> None:
    """A damaged chunk with images is to the odometry like damaged images in a folder."""
    chunk = open_store(session).topics["/pair0/left/image_raw"].places[4].chunk
    path = changed(session, tmp_path / "walk.mcap", chunk + 200)
    done = CliRunner().invoke(app, ["record", str(path), "--out", str(tmp_path / "again.mcap")])
    assert done.exit_code == 0, done.output
    assert "/rosout" in open_store(tmp_path / "again.mcap").topics
    info = CliRunner().invoke(app, ["info", str(path)])
    assert info.exit_code == 0, info.output


def test_random_damage_raises_only_graphvio_errors(session: Path, tmp_path: Path) -> None:
    """Sixty files with one to three bytes changed, some of them cut, with checksums and without, by half."""
    whole = session.read_bytes()
    without = bytearray(whole)
    for chunk in chunks(session):
        without[chunk + 9 + 24 : chunk + 9 + 28] = bytes(4)
    rig = open_source(session).rig
    rng = np.random.default_rng(7)
    records = _records(whole)
    path = tmp_path / "walk.mcap"
    refused = 0
    for number in range(60):
        data = bytearray(without if number % 2 else whole)
        for _ in range(int(rng.integers(1, 4))):
            # half of the changes in the first bytes of records, of which there are few
            near = rng.random() < 0.5
            at = int(rng.choice(records) + rng.integers(0, 30)) if near else int(rng.integers(8, len(data)))
            data[min(at, len(data) - 1)] = int(rng.integers(0, 256))
        if number % 6 == 5:
            del data[int(rng.integers(0, len(data))) :]
        path.write_bytes(data)
        try:
            for measurement in open_source(path, rig if number % 3 == 0 else None):
                assert isinstance(measurement, ImuSample | FrameSet)
        except GraphvioError:
            refused += 1
    assert refused < 40


def _records(data: bytes) -> list[int]:
    found, at = [], 8
    while at + 9 <= len(data) - 8:
        found.append(at)
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return found

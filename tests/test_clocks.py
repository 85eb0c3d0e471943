"""Description of a session's clocks: backward stamps, jumps, latency and its drift, synchronisation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recordings import write_euroc
from test_bags import bag, messages
from typer.testing import CliRunner

from graphvio.cli import app
from graphvio.errors import SessionError
from graphvio.sessions import cdr
from graphvio.sessions.stamps import compare_clocks, compare_topics
from graphvio.sources.description import describe

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

PERIOD_NS = 50_000_000


def stamps(seconds: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return 1_700_000_000_000_000_000 + np.arange(int(20 * seconds), dtype=np.int64) * PERIOD_NS


def test_drift_is_found_despite_late_messages() -> None:
    """0.3 ms a minute, where a tenth of the messages is up to 20 ms late."""
    header = stamps(120.0)
    rng = np.random.default_rng(0)
    late = 2_100_000 + 0.3e6 * (header - header[0]) / 60e9 + rng.normal(0.0, 5e4, len(header))
    late = late + (rng.random(len(header)) < 0.1) * rng.uniform(0.0, 2e7, len(header))
    found = compare_clocks(header, header + late.astype(np.int64))
    assert found.latency_ms == pytest.approx(2.4, abs=0.1)
    assert found.drift_ms_per_minute is not None
    assert found.drift_sigma is not None
    assert found.drift_ms_per_minute == pytest.approx(0.3, abs=3 * found.drift_sigma)
    assert found.drift_sigma < 0.03
    assert (found.backward, found.jumps) == (0, 0)


def test_short_recording_has_no_drift() -> None:
    header = stamps(5.0)
    assert compare_clocks(header, header + 1_000_000).drift_ms_per_minute is None
    assert compare_clocks(stamps(60.0), stamps(60.0)).drift_ms_per_minute is None


def test_backward_stamps_and_jumps_are_counted() -> None:
    logged = stamps(20.0)
    header = logged.copy()
    header[100] = header[99]
    header[200:] += 3_600_000_000_000
    header[300:] -= 3_600_000_000_000
    found = compare_clocks(header, logged)
    assert found.backward == 2
    assert found.jumps == 2


def test_compare_topics_uses_the_nearest_stamps() -> None:
    left = stamps(10.0)
    right = np.delete(left + 400_000, [5, 6])
    right[50] += 3_000_000
    found = compare_topics(left, right)
    assert found is not None
    assert found.matched == len(left) - 2
    assert found.median_ms == pytest.approx(0.4)
    assert found.largest_ms == pytest.approx(3.4)
    assert compare_topics(left, left[:1]) is None
    assert compare_topics(left, left + 3_600_000_000_000) is None


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap file"])
def test_describe_compares_clocks_and_cameras_of_bags(kind: str, tmp_path: Path) -> None:
    """Right images of the first pair are 0.5 ms late."""

    def shifted(message: tuple[str, str, int, bytes]) -> tuple[str, str, int, bytes]:
        topic, type_name, logged_ns, data = message
        if topic != "/pair0/right/image_raw":
            return message
        image = cdr.decode(data, type_name)
        image.header.stamp.nanosec += 500_000
        return topic, type_name, logged_ns, cdr.encode(image)

    recording = write_euroc(tmp_path / "walk", frames=6)
    (tmp_path / "bags").mkdir()
    path = bag(kind, [shifted(message) for message in messages(recording, tmp_path)], tmp_path / "bags")
    found = describe(path)
    topics = {topic.name: topic for topic in found.topics}
    assert topics["/imu"].latency_ms == pytest.approx(3.0)
    assert topics["/pair0/right/image_raw"].latency_ms == pytest.approx(2.5)
    assert topics["/tf_static"].clock is None
    offsets = {(each.first, each.second): each.offset for each in found.synchronisation}
    sides = offsets["pair0 left", "pair0 right"]
    assert sides is not None
    assert (sides.matched, sides.median_ms, sides.largest_ms) == (6, 0.5, 0.5)
    pairs = offsets["pair0 left", "pair1 left"]
    assert pairs is not None
    assert pairs.largest_ms == 0.0
    done = CliRunner().invoke(app, ["info", str(path)])
    assert done.exit_code == 0
    assert "pairs pair0, pair1, with IMU" in done.stdout
    assert "recorded 3.00 ms after their stamps" in done.stdout
    assert "pair0 left to pair0 right: 6 of 6 images, the second 0.500 ms later (median), 0.500 ms" in done.stdout


def test_describe_of_no_session_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="is no session or bag"):
        describe(write_euroc(tmp_path / "walk", frames=2))
    with pytest.raises(SessionError, match="does not exist"):
        describe(tmp_path / "none.bag")

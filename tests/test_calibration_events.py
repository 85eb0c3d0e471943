"""Events of the calibration on a real recording, whose rig file is good."""

from __future__ import annotations

import pytest
from real_clip import CLIP, real_clip

from graphvio import Config, Odometry, open_source
from graphvio.measurements.events import EventKind


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
def test_good_rig_file_is_not_reported_as_wrong() -> None:
    """Its calibration differs from the file's by less than its own standard deviations, but not by nothing."""
    source = open_source(real_clip(), to_s=6.0)
    odometry = Odometry(source.rig, Config())
    for measurement in source:
        odometry.process(measurement)
    odometry.finish()
    assert odometry.calibration is not None
    assert not odometry.calibration.is_file_exact
    kinds = {event.kind for event in odometry.take_events()}
    assert not kinds & {
        EventKind.CALIBRATION_CORRECTED,
        EventKind.CALIBRATION_CHANGED,
        EventKind.CALIBRATION_REFUSED,
    }

"""Names in messages."""

import pytest

from graphvio.wording import listed, nearest


@pytest.mark.parametrize(
    ("typed", "known"),
    [("piars", "pairs"), ("exposure", "exposure_us"), ("rate", "rate_hz"), ("gyro_noise", "gyro_noise_density")],
)
def test_a_near_name_is_proposed(typed: str, known: str) -> None:
    assert nearest(typed, ["other", known, "something"]) == f"; did you mean {known!r}?"


@pytest.mark.parametrize(
    ("typed", "known"),
    [
        ("colour", "corners"),
        ("camera", "calibration"),
        ("config", "confidence"),
        ("gravity", "parity"),
        ("fps", "speed"),
    ],
)
def test_an_unrelated_name_is_not_proposed(typed: str, known: str) -> None:
    assert nearest(typed, [known]) == ""


def test_a_long_list_is_cut() -> None:
    names = [f"/camera{k}" for k in range(30)]
    assert listed(names[:9]) == ", ".join(names[:9])  # not "and 1 more"
    assert listed(names) == ", ".join(names[:8]) + " and 22 more"
    assert listed([]) == "none"

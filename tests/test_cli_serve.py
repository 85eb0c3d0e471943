"""``graphvio serve``, as it is typed: a client takes keyframes and corrects; wrong settings are told at once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from graphvio.errors import ServiceError

pytest.importorskip("grpc")

from graphvio.slam.client import Client

SOON_S = 120.0


def serve(*arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "from graphvio.cli import main; main()", "serve", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def address_of(process: subprocess.Popen[str]) -> str:
    """What the command tells of its service."""
    assert process.stderr is not None
    told = next(line for line in process.stderr if line.startswith("gRPC: "))
    return told.removeprefix("gRPC: ").strip()


def test_keyframes_go_out_and_a_correction_comes_in(room_walk: Path) -> None:
    process = serve(f"replay:{room_walk}?speed=0.7", "--port", 0)
    try:
        with Client(address_of(process)) as client:
            map_T_odom = np.eye(4)
            map_T_odom[:3, 3] = [1.0, 2.0, 3.0]
            keyframes, results = [], []
            for keyframe in client.keyframes(with_images=True):
                keyframes.append(keyframe)
                if len(keyframes) == 1:
                    results.append(client.correct(keyframe.id, map_T_odom @ keyframe.odom_T_body, 1e-4 * np.eye(6)))
        assert process.wait(SOON_S) == 0
    finally:
        process.kill()
    assert [each.id for each in keyframes] == list(range(len(keyframes)))
    assert len(keyframes) > 3
    assert keyframes[0].images[0][0].shape == (480, 640)
    assert results[0].accepted
    assert results[0].map_T_odom is not None
    np.testing.assert_allclose(results[0].map_T_odom, map_T_odom, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--host", "0.0.0.0"), "TLS certificate"),
        (("--tls-cert", "cert.pem"), "without its key"),
        (("--for", "-1"), "--for"),
        (("--png",), "--record"),
    ],
)
def test_what_cannot_be_is_one_line_and_no_sensor_is_started(
    room_walk: Path, arguments: tuple[str, ...], told: str
) -> None:
    process = serve(f"replay:{room_walk}", *arguments)
    _, errors = process.communicate(timeout=SOON_S)
    assert process.returncode == 2
    assert told in errors
    assert len(errors.strip().splitlines()) == 1


def test_nobody_serves() -> None:
    with pytest.raises(ServiceError, match="nothing listens there"):
        Client("127.0.0.1:1", timeout_s=1.0, patience_s=0.1)

"""``graphvio serve`` as it is typed: a client takes keyframes and corrects; wrong settings are refused at once."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import graphvio

from graphvio.cli.shared import EXIT_INTERRUPTED
from graphvio.errors import ServiceError

pytest.importorskip("grpc")

from graphvio.slam.client import Client

SOON_S = 120.0
CODE = """
import signal
from graphvio.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)
main()
"""


def serve(*arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", CODE, "serve", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def address_of(process: subprocess.Popen[str]) -> str:
    """Return the address of gRPC that the command prints."""
    return printed(process, "gRPC: ").removeprefix("gRPC: ")


def printed(process: subprocess.Popen[str], start: str) -> str:
    """Return the next line that begins so."""
    assert process.stderr is not None
    return next(line for line in process.stderr if line.startswith(start)).strip()


def test_serve_sends_keyframes_and_takes_a_correction(room_walk: Path) -> None:
    process = serve(f"{room_walk}?speed=2", "--port", 0)
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
    assert keyframes[0].images[0][0].shape == (240, 320)
    assert results[0].accepted
    assert results[0].map_T_odom is not None
    np.testing.assert_allclose(results[0].map_T_odom, map_T_odom, atol=1e-9)


def test_serve_slow_reader_gets_the_last_keyframe(room_walk: Path) -> None:
    process = serve(f"replay:{room_walk}?speed=2", "--port", 0)
    try:
        with Client(address_of(process), patience_s=0.0) as client:
            stream = client.keyframes(with_images=True)
            ids = [next(stream).id]
            assert "60 s at most" in printed(process, "waiting for")
            info = client.info()
            ids += [keyframe.id for keyframe in stream]
        assert process.wait(SOON_S) == 0
    finally:
        process.kill()
    assert info.has_ended
    assert ids == list(range(info.next_keyframe_id))


def test_serve_second_ctrl_c_does_not_wait_for_readers(room_walk: Path) -> None:
    process = serve(f"replay:{room_walk}?speed=2", "--port", 0)
    try:
        with Client(address_of(process), patience_s=0.0) as client:
            stream = client.keyframes(with_images=True)
            next(stream)
            while client.info().next_keyframe_id < 4:  # more than is on its way
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            printed(process, "waiting for")
            process.send_signal(signal.SIGINT)
            assert process.wait(SOON_S) == EXIT_INTERRUPTED
            with pytest.raises(ServiceError):  # the end is missing
                list(stream)
    finally:
        process.kill()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--host", "0.0.0.0"), "TLS certificate"),
        (("--tls-cert", "cert.pem"), "without its key"),
        (("--for", "-1"), "--for"),
        (("--png",), "--record"),
    ],
)
def test_serve_wrong_option_is_one_line(room_walk: Path, arguments: tuple[str, ...], expected: str) -> None:
    done = graphvio("serve", f"replay:{room_walk}", *arguments)
    assert done.returncode == 2
    assert expected in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_serve_wrong_keys_or_port_leave_no_recording(room_walk: Path, tmp_path: Path) -> None:
    def refusal(*arguments: object) -> str:
        done = graphvio("serve", f"replay:{room_walk}", *arguments, "--record", tmp_path / "walk.mcap")
        assert done.returncode == 2
        assert len(done.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "walk.mcap").exists()
        return done.stderr

    for name in ("server.pem", "server.key", "token"):
        (tmp_path / name).write_text("short\n")
        (tmp_path / name).chmod(0o600)
    certificate, key, token = tmp_path / "server.pem", tmp_path / "server.key", tmp_path / "token"
    assert "the TLS key cannot be read" in refusal(
        "--port", 0, "--tls-cert", certificate, "--tls-key", tmp_path / "absent"
    )
    assert "are no TLS certificate and key" in refusal("--port", 0, "--tls-cert", certificate, "--tls-key", key)
    assert "is no token" in refusal("--port", 0, "--token-file", token)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"127.0.0.1:{port}: cannot be listened on" in refusal("--port", port)


def test_client_without_a_server_is_an_error() -> None:
    with pytest.raises(ServiceError, match="nothing listens there"):
        Client("127.0.0.1:1", timeout_s=1.0, patience_s=0.1)

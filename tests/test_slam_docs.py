"""What docs/how-to/slam-interface.md shows of the client is executed, against a real server in this process."""

import ast
import re
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import served
from pages import ROOT, python_blocks

pytest.importorskip("grpc")

from graphvio.slam.service.options import ServiceOptions
from graphvio.slam.service.server import GrpcServer

PAGE = (ROOT / "docs/how-to/slam-interface.md").read_text()


def example() -> str:
    (block,) = (block for block in python_blocks(PAGE) if "def build_map" in block)
    return block


def run(address: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", example(), address]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT, check=False)


def test_client_of_the_page_runs() -> None:
    odometry = served.SyntheticOdometry()
    odometry.keyframe_log.add(served.keyframe(0))

    def go_on() -> None:
        for number in range(1, 12):
            odometry.keyframe_log.add(served.keyframe(number))
            time.sleep(0.02)
        odometry.end()

    with GrpcServer(odometry, ServiceOptions(port=0)) as server:
        thread = threading.Thread(target=go_on)
        thread.start()
        done = run(server.address)
        thread.join()
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "pairs: ['front', 'back']"
    assert lines[-1] == "keyframes: 12"
    assert sum(line.endswith("7 (48, 64)") for line in lines) == 12
    assert sum(line.startswith("corrected") for line in lines) == 1
    ((keyframe_id, map_T_body, covariance),) = odometry.corrections
    assert keyframe_id == 0
    np.testing.assert_array_equal(map_T_body, np.eye(4))
    np.testing.assert_array_equal(covariance, np.diag([1e-4] * 3 + [1e-2] * 3))


def test_client_of_the_page_without_server_ends_with_one_line() -> None:
    done = run("127.0.0.1:9")
    assert done.returncode == 1
    assert done.stderr == "slam: 127.0.0.1:9: nothing listens there; is the service running, and the port right?\n"


def test_other_code_of_the_page_can_be_parsed() -> None:
    blocks = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    assert blocks
    assert all(ast.parse(block).body for block in blocks)


def test_calls_of_the_page_are_those_of_the_proto() -> None:
    proto = (ROOT / "graphvio/slam/service/graphvio.proto").read_text()
    assert re.findall(r"^\| `(\w+)` \| [^|]+ \|$", PAGE, re.MULTILINE)[-6:] == [
        call
        for call in ("GetInfo", "GetStatus", "StreamEstimates", "StreamKeyframes", "StreamEvents", "Correct")
        if f"rpc {call}(" in proto
    ]

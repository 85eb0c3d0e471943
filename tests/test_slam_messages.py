import re
import tomllib
from dataclasses import fields, replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import served
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import two_pair_rig

from graphvio.errors import MeasurementError, ServiceError
from graphvio.measurements.estimate import Estimate, Status
from graphvio.slam.keyframe import CorrectionResult, Keyframe, Landmarks

pytest.importorskip("grpc")

from graphvio.slam.checks import check_covariance, check_pose
from graphvio.slam.service import convert, messages

ROOT = Path(__file__).parents[1]
SERVICE = ROOT / "graphvio/slam/service"
DIAGNOSTICS = {"innovations", "rates", "pairs", "stage_ms", "vision_sigmas"}


def assert_same(one: Any, other: Any, where: str = "") -> None:
    """Compare field by field, bit by bit and with the same types of arrays."""
    if isinstance(one, np.ndarray):
        assert isinstance(other, np.ndarray), where
        assert (one.dtype, one.shape) == (other.dtype, other.shape), where
        np.testing.assert_array_equal(one, other, err_msg=where)
    elif isinstance(one, dict):
        assert list(one) == list(other), where
        for key in one:
            assert_same(one[key], other[key], f"{where}[{key}]")
    elif isinstance(one, tuple):
        assert len(one) == len(other), where
        for a, b in zip(one, other, strict=True):
            assert_same(a, b, where)
    elif isinstance(one, Keyframe | Landmarks | Estimate):
        for field in fields(one):
            if field.name not in DIAGNOSTICS:
                assert_same(getattr(one, field.name), getattr(other, field.name), f"{where}.{field.name}")
    else:
        assert (type(one), one) == (type(other), other), where


def sent(message: Any) -> Any:
    """Return a message after a round trip."""
    return type(message).FromString(message.SerializeToString())


@pytest.mark.parametrize("points", [0, 1, 300])
@pytest.mark.parametrize("number", [0, 5])
def test_keyframe_round_trip(number: int, points: int) -> None:
    keyframe = served.keyframe(number, epoch=3, points=points)
    assert_same(keyframe, convert.keyframe_of(sent(convert.keyframe_message(keyframe, True, True))))


def test_calibrated_rig_round_trip_is_one_object_for_all_keyframes() -> None:
    rig = two_pair_rig()
    one, other = (
        convert.keyframe_of(sent(convert.keyframe_message(replace(served.keyframe(k), calibrated_rig=rig), True, True)))
        for k in (1, 2)
    )
    assert one.calibrated_rig is not None
    assert one.calibrated_rig is other.calibrated_rig
    assert convert.rig_text(one.calibrated_rig) == convert.rig_text(rig)


def test_images_and_descriptors_are_sent_on_request_only() -> None:
    keyframe = served.keyframe(2)
    bare = convert.keyframe_of(sent(convert.keyframe_message(keyframe, False, False)))
    assert bare.images == {}
    assert bare.landmarks.descriptors.shape == (7, 0)
    assert_same(keyframe.landmarks.points_body, bare.landmarks.points_body)


def test_landmarks_without_descriptors_and_of_views_round_trip() -> None:
    keyframe = served.keyframe(2)
    marks = replace(keyframe.landmarks, descriptors=np.zeros((7, 0), dtype=np.uint8))
    strided = replace(
        keyframe, landmarks=marks, images={1: (np.eye(20, dtype=np.uint8)[::2, 3:], np.eye(5, dtype="u1"))}
    )
    assert_same(strided, convert.keyframe_of(sent(convert.keyframe_message(strided, True, True))))
    assert_same(
        Landmarks.none(),
        convert.keyframe_of(
            sent(convert.keyframe_message(replace(keyframe, landmarks=Landmarks.none()), False, True))
        ).landmarks,
    )


@pytest.mark.parametrize("status", list(Status))
def test_estimate_round_trip(status: Status) -> None:
    whole = replace(served.estimate(7, epoch=2), status=status)
    assert_same(whole, convert.estimate_of(sent(convert.estimate_message(whole))))
    bare = Estimate(served.START_NS, status, None, None)
    assert_same(bare, convert.estimate_of(sent(convert.estimate_message(bare))))


def test_every_field_of_an_estimate_is_sent_or_a_diagnostic() -> None:
    names = {re.sub("(^|_)nav(_|$)", r"\1odom\2", field.name) for field in fields(Estimate)}
    assert {field.name for field in messages.Estimate.DESCRIPTOR.fields} == names - DIAGNOSTICS


def test_results_and_figures_round_trip() -> None:
    for result in (
        CorrectionResult(True, "", None, 22.46, np.eye(4)),
        CorrectionResult(False, "off", 1 / 3, 22.46, None),
    ):
        back = convert.result_of(sent(convert.result_message(result)))
        for field in fields(result):
            assert_same(getattr(result, field.name), getattr(back, field.name), field.name)
    figures = {"a": None, "b": 1 / 3, "c": 2**62, "d": "", "e": "ü", "f": float("inf"), "g": 0, "h": 0.0}
    assert_same(figures, convert.status_of(sent(convert.status_message(figures))))
    numpys: dict[str, Any] = {"a": np.int64(3), "b": np.float32(0.5), "c": 2**70, "d": True}
    assert convert.status_of(sent(convert.status_message(numpys))) == {"a": 3, "b": 0.5, "c": 2.0**70, "d": 1}


def test_rig_round_trip_without_masks(tmp_path: Path) -> None:
    mask = tmp_path / "mask.png"
    mask.write_bytes(b"")
    rig = served.rig(mask)
    back = convert.rig_of(convert.rig_text(rig), "far")
    assert (back.name, back.imu, [pair.name for pair in back.pairs]) == (rig.name, rig.imu, ["front", "back"])
    for camera, same in zip(rig.cameras, back.cameras, strict=True):
        assert (camera.name, camera.model, camera.size_px) == (same.name, same.model, same.size_px)
        for name in ("intrinsics", "distortion", "body_T_cam"):
            np.testing.assert_array_equal(getattr(camera, name), getattr(same, name))
        assert same.mask is None


def test_arrays_of_wrong_size_raise_with_their_field() -> None:
    message = convert.keyframe_message(served.keyframe(2), True, True)
    del message.landmarks.points_body[-1]
    with pytest.raises(ServiceError, match="keyframe 2: points_body: has 20 values; it must have 21"):
        convert.keyframe_of(message)
    message = convert.keyframe_message(served.keyframe(2), True, True)
    message.images[0].left.width += 1
    with pytest.raises(ServiceError, match="keyframe 2: image: has 3072 values"):
        convert.keyframe_of(message)
    with pytest.raises(ServiceError, match="status is 0"):
        convert.estimate_of(messages.Estimate())


@settings(deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=36, max_size=36))
def test_checks_of_random_numbers_return_or_raise_measurement_errors(numbers: list[float]) -> None:
    for check, matrix in (
        (check_pose, np.array(numbers[:16]).reshape(4, 4)),
        (check_covariance, np.array(numbers).reshape(6, 6)),
    ):
        refusal = ""
        try:
            check(matrix, "matrix")
        except MeasurementError as error:
            refusal = str(error)
        assert refusal == "" or refusal.startswith("matrix: ")


def test_invalid_poses_and_covariances_raise() -> None:
    good = served.pose(np.random.default_rng(0))
    mirrored, bent, shifted, huge = (good.copy() for _ in range(4))
    mirrored[:3, 0] *= -1.0
    bent[0, 0] += 1e-3
    shifted[3] = [1.0, 0.0, 0.0, 1.0]
    huge[0, 0] = 1e300
    check_pose(good, "p")
    for wrong, text in (
        (mirrored, "determinant -1"),
        (bent, "differs from 1"),
        (shifted, "last row"),
        (huge, "no rot"),
    ):
        with pytest.raises(MeasurementError, match=text):
            check_pose(wrong, "p")
    check_covariance(np.diag([1e-12, 1, 1, 1, 1, 1e6]), "c")
    lopsided = np.eye(6)
    lopsided[0, 1] = 1e-3
    for wrong, text in ((lopsided, "symmetric"), (np.zeros((6, 6)), "definite"), (-np.eye(6), "definite")):
        with pytest.raises(MeasurementError, match=text):
            check_covariance(wrong, "c")


def made_by(code: str) -> str:
    """Return the version of protobuf that generated some code."""
    protobuf = re.search(r"Protobuf Python Version: ([\d.]+)", code)
    assert protobuf
    return protobuf[1]


def test_generated_code_matches_the_proto(tmp_path: Path) -> None:
    protoc = pytest.importorskip("grpc_tools.protoc")
    spec = find_spec("grpc_tools")
    assert spec is not None
    assert spec.origin is not None
    assert not protoc.main(
        [
            "protoc",
            f"--proto_path={ROOT}",
            f"--proto_path={Path(spec.origin).parent / '_proto'}",
            f"--python_out={tmp_path}",
            str(SERVICE / "graphvio.proto"),
        ]
    )
    made = (tmp_path / "graphvio/slam/service/graphvio_pb2.py").read_text()
    committed = (SERVICE / "graphvio_pb2.py").read_text()
    if made_by(made) != made_by(committed):
        pytest.skip(f"protoc is of protobuf {made_by(made)}; the committed code is of {made_by(committed)}")
    assert made == committed, "graphvio_pb2.py is old; run  scripts/generate_proto"


def test_bounds_of_the_extra_match_the_generated_code() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    protobuf = made_by((SERVICE / "graphvio_pb2.py").read_text())
    # A runtime may be of the generated code's major version, not older than it, or of the next one.
    assert extras["serve"][1:] == [f"protobuf>={protobuf},<{int(protobuf.split('.')[0]) + 2}"]


def test_proto_has_a_comment_on_every_call() -> None:
    lines = (SERVICE / "graphvio.proto").read_text().splitlines()
    calls = [(before, line) for before, line in pairwise(lines) if line.startswith("  rpc ")]
    assert len(calls) == 6
    assert all(before.startswith("  // ") for before, _ in calls)

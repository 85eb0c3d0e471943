from pathlib import Path

import numpy as np
import pytest

from graphvio.errors import TrajectoryError
from graphvio.geometry import se3, so3_exp
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory, save_trajectory, stamp_ns_from_seconds, tum_line

START_NS = 1_403_636_579_763_555_584


def some_trajectory(count: int = 20) -> Trajectory:
    poses = [se3(so3_exp(np.array([0.1 * k, -0.2, 0.3 * k])), np.array([k, 0.5 * k, -k])) for k in range(count)]
    return Trajectory(START_NS + 50_000_001 * np.arange(count), np.array(poses))


def test_save_then_load_returns_equal_stamps_and_poses(tmp_path: Path) -> None:
    written = some_trajectory()
    save_trajectory(written, tmp_path / "t.txt")
    read = load_trajectory(tmp_path / "t.txt")
    assert np.array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_allclose(read.nav_T_body, written.nav_T_body, atol=3e-9)


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1403636579.763555584", START_NS),
        ("1403636579.7635555841", START_NS),
        ("0.05", 50_000_000),
        ("-0.000000001", -1),
        ("1.403636579763555584e+09", START_NS),
        ("7", 7_000_000_000),
    ],
)
def test_stamp_ns_from_seconds_is_exact(text: str, stamp: int) -> None:
    assert stamp_ns_from_seconds(text) == stamp


@pytest.mark.parametrize("text", ["nan", "inf", "x", "", "1e99", "1e999999999"])
def test_stamp_ns_from_seconds_invalid_text_raises(text: str) -> None:
    with pytest.raises(ValueError, match="is no time"):
        stamp_ns_from_seconds(text)


def test_tum_line_has_nine_decimals_positive_scalar_part_and_no_negative_zero() -> None:
    turned = so3_exp(np.array([0.0, 0.0, 1.5 * np.pi]))  # w < 0 if taken as it comes
    line = tum_line(-5, se3(turned, np.array([-1e-12, 1.0, -2.0])))
    assert line.split()[:4] == ["-0.000000005", "0.000000000", "1.000000000", "-2.000000000"]
    assert line.split()[4:6] == ["0.000000000", "0.000000000"]
    np.testing.assert_allclose([float(v) for v in line.split()[6:]], [-np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)


def test_load_euroc_reads_scalar_part_first(tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    file.write_text(
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v\n"
        f"{START_NS},1.0,2.0,3.0,0.8,0.0,0.0,0.6,9,9,9\n{START_NS + 5},1,2,3,1,0,0,0,9,9,9\n"
    )
    read = load_trajectory(file)
    assert read.stamps_ns.tolist() == [START_NS, START_NS + 5]
    np.testing.assert_allclose(read.rotations[0] @ [1, 0, 0], [0.28, 0.96, 0.0], atol=1e-12)
    np.testing.assert_allclose(read.positions[0], [1, 2, 3])


def test_load_commas_with_decimal_stamps_is_tum(tmp_path: Path) -> None:
    file = tmp_path / "device.csv"
    file.write_text("12.5, 1, 2, 3, 0, 0, 0.6, 0.8\n12.5, 1, 2, 3, 0, 0, 0.6, 0.8\n12.53, 1, 2, 4, 0, 0, 0, 1\n")
    read = load_trajectory(file)
    assert read.stamps_ns.tolist() == [12_500_000_000, 12_530_000_000]  # a pose that was logged twice is one
    np.testing.assert_allclose(read.rotations[0] @ [1, 0, 0], [0.28, 0.96, 0.0], atol=1e-12)


def test_load_header_without_comment_sign_is_skipped(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text("stamp_ns,x,y,z,qw,qx,qy,qz\n5,1,2,3,1,0,0,0\n")
    assert load_trajectory(file).stamps_ns.tolist() == [5]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no pose"),
        ("# only a comment\n", "holds no pose"),
        ("1.0 0 0 0 0 0 0 1\n1.0 0 0 1 0 0 0 1\n", "line 2: its stamp does not come after"),
        ("1.0 0 0 0 0 0 1\n", "line 1: has 7 columns; .*stamp_s x y z"),
        ("1,0,0,0\n", "has 4 columns; .*stamp_ns,x,y,z,qw"),
        ("1.0 0 0 nan 0 0 0 1\n", "line 1: holds NaN"),
        ("1.0 0 0 zero 0 0 0 1\n", "line 1: is not numeric"),
        ("nan 0 0 0 0 0 0 1\n", "line 1: is not numeric"),
        ("1.0 0 0 0 0 0 0 0\n", "norm 0, not 1"),
        ("1.0 0 0 0 0 0 0 2\n", "norm 2, not 1"),
        ("99999999999999999999,0,0,0,1,0,0,0\n", "is no time"),
    ],
)
def test_load_invalid_line_raises_with_its_number(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "bad.txt"
    file.write_text(text)
    with pytest.raises(TrajectoryError, match=message) as caught:
        load_trajectory(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("unit", "in_s", "start_s"),
    [
        ("milliseconds", 10**3, 1_700_000_000),
        ("microseconds", 10**6, 1_700_000_000),
        ("microseconds", 10**6, 0),
        ("nanoseconds", 10**9, 0),  # milliseconds from 0 may be a pose every 50 s
    ],
)
def test_load_tum_with_stamps_in_another_unit_names_it(tmp_path: Path, unit: str, in_s: int, start_s: int) -> None:
    file = tmp_path / "bad.txt"
    stamps = [start_s * in_s + k * in_s // 20 for k in range(10)]
    file.write_text("".join(f"{stamp} 0 0 0 0 0 0 1\n" for stamp in stamps))
    with pytest.raises(TrajectoryError, match=unit):
        load_trajectory(file)


def test_load_tum_with_unix_times_in_nanoseconds_is_taken(tmp_path: Path) -> None:
    """As ORB-SLAM3 writes them."""
    stamps_ns = [1_403_636_579_763_555_584 + 50_000_000 * k for k in range(10)]
    file = tmp_path / "CameraTrajectory.txt"
    file.write_text("".join(f"{stamp}.000000 {k} 0 0 0 0 0 1\n" for k, stamp in enumerate(stamps_ns)))
    trajectory = load_trajectory(file)
    assert trajectory.stamps_ns.tolist() == stamps_ns
    assert trajectory.nav_T_body[:, 0, 3].tolist() == list(range(10))


def test_load_tum_of_long_ago_or_sparse_is_taken(tmp_path: Path) -> None:
    file = tmp_path / "good.txt"
    for stamps in ([0, 60, 120, 180, 240], [1e9 + 60 * k for k in range(5)]):
        file.write_text("".join(f"{stamp} 0 0 0 0 0 0 1\n" for stamp in stamps))
        assert len(load_trajectory(file)) == 5


def test_load_euroc_with_stamps_in_seconds_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "bad.csv"
    file.write_text("".join(f"{stamp},0,0,0,1,0,0,0\n" for stamp in range(1_700_000_000, 1_700_000_010)))
    with pytest.raises(TrajectoryError, match="nanoseconds"):
        load_trajectory(file)


def test_load_kitti_with_times_in_nanoseconds_names_the_unit(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "times.txt").write_text("1700000000000000000\n")
    with pytest.raises(TrajectoryError, match=r"times\.txt.*nanoseconds"):
        load_trajectory(file)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 2 3\n", "line 2: has 3 columns"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "has 1 poses, and .* 2 stamps"),
    ],
)
def test_load_kitti_with_a_wrong_row_names_it(tmp_path: Path, poses: str, message: str) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(poses)
    (tmp_path / "times.txt").write_text("0\n1\n")
    with pytest.raises(TrajectoryError, match=message) as caught:
        load_trajectory(file)
    assert str(file) in str(caught.value)


def test_load_or_save_unusable_path_raises(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(bytes(range(128, 256)))
    with pytest.raises(TrajectoryError, match="not a text file"):
        load_trajectory(tmp_path / "binary")
    with pytest.raises(TrajectoryError, match="cannot be read"):
        load_trajectory(tmp_path / "absent.txt")
    with pytest.raises(TrajectoryError, match="cannot be written"):
        save_trajectory(some_trajectory(), tmp_path / "no" / "folder.txt")


def test_trajectory_invalid_values_raise() -> None:
    good = some_trajectory(3)
    bad = good.nav_T_body.copy()
    bad[1, 0, 3] = np.inf
    with pytest.raises(TrajectoryError, match="pose 1 holds NaN or infinity"):
        Trajectory(good.stamps_ns, bad)
    with pytest.raises(TrajectoryError, match="3 poses"):
        Trajectory(good.stamps_ns[:2], good.nav_T_body)
    with pytest.raises(TrajectoryError, match="does not come after"):
        Trajectory(good.stamps_ns[::-1], good.nav_T_body)


def test_at_interpolates_linearly_and_by_slerp() -> None:
    poses = np.array(
        [se3(so3_exp(np.array([0.0, 0.0, a])), np.array([x, 0.0, 0.0])) for a, x in ((0.0, 0.0), (1.0, 4.0))]
    )
    between, known = Trajectory(np.array([0, 100]), poses).at(np.array([-1, 0, 25, 100, 101]), max_gap_s=1.0)
    assert known.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(between.positions[:, 0], [0.0, 1.0, 4.0])
    np.testing.assert_allclose(between.rotations[1], so3_exp(np.array([0.0, 0.0, 0.25])), atol=1e-12)


def test_at_leaves_out_gaps_but_not_equal_stamps() -> None:
    trajectory = Trajectory(np.array([0, 10, 2_000_000_000]), some_trajectory(3).nav_T_body)
    _, known = trajectory.at(np.array([5, 10, 1_000_000_000, 2_000_000_000]), max_gap_s=0.1)
    assert known.tolist() == [True, True, False, True]


def test_at_with_one_pose_or_none() -> None:
    one = some_trajectory(1)
    assert one.at(np.array([START_NS - 1, START_NS, START_NS + 1]), 1.0)[1].tolist() == [False, True, False]
    assert one.select(slice(0, 0)).at(np.array([START_NS]), 1.0)[1].tolist() == [False]


def test_distances_duration_and_transformed() -> None:
    trajectory = some_trajectory(3)
    np.testing.assert_allclose(trajectory.distances, [0.0, 1.5, 3.0])
    other_T_nav = se3(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(trajectory.transformed(other_T_nav).positions[1], [0.5, 1.0, -1.0], atol=1e-12)
    assert trajectory.duration_s == pytest.approx(0.100000002)

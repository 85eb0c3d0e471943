"""``graphvio benchmark``: layouts of the data sets, and what the command makes of them."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import dataset_layouts
import numpy as np
import pytest
from command_line import graphvio
from dataset_layouts import rendered_walk, true_poses
from real_clip import CLIP, real_clip

from graphvio.benchmark.datasets import DATASETS, dataset_of, find_sequences
from graphvio.benchmark.run import evaluate_with
from graphvio.benchmark.table import lengths_m, published_on
from graphvio.errors import BenchmarkError
from graphvio.evaluation import evaluate
from graphvio.measurements.sensors import FrameSet, ImuSample
from graphvio.rig_files import load_rig
from graphvio.sources import open_source
from graphvio.trajectory_files import load_trajectory


def hilti_bag(recording: Path, path: Path) -> Path:
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    from test_bags import messages, ros1_bag

    def renamed(topic: str) -> str:
        for name, new in (("left/image", "cam0"), ("right/image", "cam1")):
            if name in topic:
                return f"/alphasense/{new}/image_raw"
        return "/alphasense/imu"

    wanted = ("sensor_msgs/msg/Image", "sensor_msgs/msg/Imu")
    found = messages(recording, path.parent)
    (path.parent / "session.mcap").unlink()
    return ros1_bag([(renamed(each[0]), *each[1:]) for each in found if each[1] in wanted], path)


LAYOUTS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "euroc": ("MH_03", dataset_layouts.write_euroc),
    "tum-vi": ("room1", dataset_layouts.write_tum_vi),
    "uzh-fpv": ("indoor_forward_3", dataset_layouts.write_uzh_fpv),
    "kitti": ("04", dataset_layouts.write_kitti),
    "hilti-2022": ("exp04", lambda folder: dataset_layouts.write_hilti(folder, hilti_bag)),
    "monado": ("MIO01", dataset_layouts.write_monado),
}


@pytest.mark.parametrize("key", LAYOUTS)
def test_layout_is_found_with_its_calibration_truth_images_and_samples(key: str, tmp_path: Path) -> None:
    name, write = LAYOUTS[key]
    path = write(tmp_path / "data")
    (found,) = find_sequences(dataset_of(key), tmp_path / "data")
    assert (found.name, found.recording) == (name, path.resolve())
    original = open_source(rendered_walk())
    source = open_source(found.recording, None if found.rig is None else load_rig(found.rig))
    measurements, expected = list(source), list(original)
    images = [each for each in measurements if isinstance(each, FrameSet)]
    for one, other in zip(images, (each for each in expected if isinstance(each, FrameSet)), strict=True):
        assert one.stamp_ns - images[0].stamp_ns == other.stamp_ns - original.start_ns
        for image, same in zip(one.images[0], other.images[0], strict=True):
            np.testing.assert_array_equal(image, same)
    samples = [each for each in measurements if isinstance(each, ImuSample)]
    if key == "kitti":
        assert not samples
    else:
        true_samples = [each for each in expected if isinstance(each, ImuSample)]
        for sample, true_sample in zip(samples, true_samples, strict=True):
            assert sample.stamp_ns == true_sample.stamp_ns
            np.testing.assert_array_equal(sample.angular_velocity, true_sample.angular_velocity)
    assert source.faults.counts == {}
    truth = load_trajectory(found.truth or source.truth or Path())
    left = source.rig.pairs[0].left
    true_left = original.rig.pairs[0].left
    np.testing.assert_allclose(left.intrinsics, true_left.intrinsics)
    if key != "kitti":
        np.testing.assert_allclose(left.body_T_cam, true_left.body_T_cam, atol=1e-9)
        estimate = true_poses() if key != "hilti-2022" else true_poses().select(slice(None, None, 10))
        assert evaluate_with(estimate, truth).ate_position_m.rmse < 1e-3
    baseline = source.rig.pairs[0].right_T_left[:3, 3]
    np.testing.assert_allclose(baseline, original.rig.pairs[0].right_T_left[:3, 3], atol=1e-6)


def test_benchmark_writes_table_document_and_report_where_one_sequence_fails(tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    dataset_layouts.write_uzh_fpv(data)
    broken = data / "indoor_forward_5_snapdragon_with_gt"
    shutil.copytree(data / "indoor_forward_3_snapdragon_with_gt", broken, symlinks=True)
    shutil.rmtree(broken / "img")
    ran = graphvio("benchmark", "uzh-fpv", data, "--out", out, "--jobs", 2, "--json")
    assert ran.returncode == 3
    document = json.loads(ran.stdout)
    good, bad = document["sequences"]
    assert (good["sequence"], good["failed"], good["note"]) == ("indoor_forward_3", False, "")
    again = evaluate(load_trajectory(Path(good["results"]) / "trajectory.txt"), true_poses())
    assert good["ate_m"] == pytest.approx(again.ate_position_m.rmse, rel=1e-6)
    assert good["ate_m"] < 0.02
    assert good["completion"] == 1.0
    assert bad["failed"]
    assert "none of its 60 framesets could be read" in bad["note"]
    assert bad["note"] in ran.stderr
    assert "indoor_45_2" in document["absent"]
    assert document["published"] == []
    index = (out / "report.html").read_text()
    assert bad["note"].replace("'", "&#39;").replace('"', "&#34;") in index
    assert re.findall(r'href="(.*?)"', index) == ["indoor_forward_3.html"]
    page = (out / "indoor_forward_3.html").read_text()
    assert page.count("data:image/png;base64,") >= 1
    assert 'href="report.html"' in page


@pytest.mark.usefixtures("without_plots")
@pytest.mark.skipif(not CLIP.is_dir(), reason="the clip of EuRoC is not there")
def test_benchmark_of_the_clip_stands_beside_published_figures(tmp_path: Path) -> None:
    ran = graphvio("benchmark", "euroc", real_clip(), "--out", tmp_path / "out", "--to", 2)
    assert ran.returncode == 0, ran.stderr
    row = next(line for line in ran.stdout.splitlines() if re.match(r"\W MH_01 ", line))
    cells = [cell.strip() for cell in re.split("[|│]", row)[1:-1]]
    assert cells[-4:] == ["0.070", "0.240", "0.037", "0.150"]
    assert float(cells[2]) < 0.02
    assert "of 80 m only: published figures are of the whole sequence" in ran.stdout
    assert "arXiv 1904.06504" in ran.stdout


def test_folder_without_sequences_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    ran = graphvio("benchmark", "euroc", tmp_path)
    assert ran.returncode == 2
    assert "holds no recording that is named like a sequence of EuRoC MAV (MH_01, MH_02, MH_03, ...)" in ran.stderr
    with pytest.raises(BenchmarkError, match="give one of euroc, tum-vi, uzh-fpv, kitti, hilti-2022, monado"):
        dataset_of("kaist")


def test_published_figures_have_sources_and_are_of_known_sequences() -> None:
    for key, dataset in DATASETS.items():
        for each in published_on(key):
            assert each.source
            assert each.read_from
            assert set(each.ate_m) <= set(dataset.sequences)
        assert set(lengths_m(key)) <= set(dataset.sequences)

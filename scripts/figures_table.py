"""The table of figures: every scene of the simulator and the real clip, run with the default configuration."""

import sys
from pathlib import Path

from graphvio.config import Config
from graphvio.pipeline import run
from graphvio.results import ResultWriter
from graphvio.simulation import SCENE_NAMES, simulate
from graphvio.sources import open_source
from graphvio.warmup import warm_up

CLIP = Path(__file__).resolve().parents[2] / "shared/data/euroc_mh01_clip"


def main() -> None:
    out = Path(sys.argv[1])
    print("| recording | pairs | IMU | ATE | drift | x real time |\n|---|---|---|---|---|---|")
    for scene in SCENE_NAMES:
        recording = out / scene
        if not recording.exists():
            simulate(scene, recording)
        for pairs in ([0, 1], [0], [1]):
            names = {0: "front", 1: "back"}
            row(out, recording, f"simulated {scene}", pairs, " + ".join(names[j] for j in pairs))
    if CLIP.is_dir():
        for with_imu in (True, False):
            row(out, CLIP, "EuRoC MH_01, first 17 s", [0], "one", with_imu=with_imu)


def row(out: Path, recording: Path, title: str, pairs: list[int], name: str, *, with_imu: bool = True) -> None:
    """Run one case and print its row."""
    rig = open_source(recording).rig.with_pairs(pairs)
    source = open_source(recording, rig if with_imu else rig.without_imu())
    config = Config()
    warm_up(source.rig, config)
    folder = out / f"results-{recording.name}-{'-'.join(map(str, pairs))}{'' if with_imu else '-no-imu'}"
    with ResultWriter(folder, source.rig, config.to_yaml()) as writer:
        summary = run(source, config, writer)
    if summary.evaluation is None:
        raise SystemExit(f"{recording}: {summary.evaluation_error}")
    path_m, drift = summary.evaluation["path_length_m"], summary.evaluation["drift_percent"]
    ate_mm = 1e3 * summary.evaluation["ate_position_m"]["rmse"]
    done = "" if summary.completion == 1.0 else f" ({100 * summary.completion:.0f} % complete)"
    print(
        f"| {title}, {path_m:.0f} m{done} | {name} | {'yes' if with_imu else 'no'} | {ate_mm:.1f} mm "
        f"| {drift:.2f} % | {summary.realtime_factor:.1f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()

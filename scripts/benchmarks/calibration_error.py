"""``scripts/benchmark calibration-error``: accuracy with calibration files that are as wrong as real ones."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median

import yaml

from benchmarks.calibration_cases import EXACT, Case, append_outcome, load_outcomes
from benchmarks.calibration_runs import CalibrationOutcome, WronglyCalibrated
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.rig import Rig
from graphvio.simulation import RIG_CHANGES, SCENE_NAMES
from graphvio.simulation.calibration_error import COMPONENTS, LEVELS, CalibrationErrorSizes
from graphvio.sources import open_source

_SCENES = ("room", "corridor", "stairs", "calibration")
_BOTH = "both"
_PAIRS = {_BOTH: (0, 1), "front": (0,), "back": (1,)}
_SINGLES = {
    "none": "each by itself",
    "one-camera": "the first one alone",
    "front+single": "the front pair and a single one to the back",
}
_ROUNDING = 1e-6
_OUT = Path("results") / "benchmarks" / "calibration-error.csv"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "calibration-error",
        help="accuracy when the calibration files are as wrong as real ones",
        description="Runs simulated scenes with exact files and with calibration errors sampled at each level; images "
        "are rendered once. Prints each run as it ends, and tables at the end, also after Ctrl-C.",
        epilog="Example: scripts/benchmark calibration-error --scenes room --levels 2 --seeds 3 --pairs both "
        "--components focal left-right-rotation",
    )
    parser.add_argument(
        "--scenes", nargs="+", default=list(_SCENES), metavar="NAME", help=f"default: {' '.join(_SCENES)}"
    )
    parser.add_argument("--levels", nargs="*", type=int, default=list(LEVELS), metavar="N", help="default: all")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="number of draws (default: 5)")
    parser.add_argument("--first-seed", type=int, default=0, metavar="N", help="of the first draw (default: 0)")
    parser.add_argument(
        "--components", nargs="+", metavar="NAME", help=f"only these errors, together: {', '.join(COMPONENTS)}"
    )
    parser.add_argument(
        "--rig-change", choices=list(RIG_CHANGES), help="the true cameras change on the way (default: they do not)"
    )
    parser.add_argument("--duration", type=float, metavar="S", help="only so much of each walk")
    parser.add_argument(
        "--pairs",
        nargs="+",
        choices=[*_PAIRS, *_SINGLES],
        default=list(_PAIRS),
        help="with the IMU, none: each camera by itself; one-camera: the first one alone; front+single: the front "
        "pair, and a camera of the other one; of a single pair, both is that pair (default: both front back)",
    )
    imu = parser.add_mutually_exclusive_group()
    imu.add_argument("--no-imu", action="store_true", help="only runs without the IMU")
    imu.add_argument("--imu", action="store_true", help="only runs with the IMU")
    parser.add_argument("--no-exact", action="store_true", help="leave out the runs with exact files")
    parser.add_argument("--config", default="default", metavar="NAME", help="profile or YAML file (default: default)")
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="KEY=VALUE", help="values of the configuration: stage.name=value"
    )
    parser.add_argument("--out", type=Path, default=_OUT, metavar="CSV", help=f"results are added (default: {_OUT})")
    parser.add_argument("--resume", action="store_true", help="take runs with the same settings from that file")
    parser.add_argument("--docs", action="store_true", help="put the tables into docs/explanation/benchmarks")
    parser.add_argument(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="take the recordings DIR/SCENE of graphvio simulate, instead of rendering for this state of the simulator",
    )
    add_data_option(parser)
    parser.set_defaults(run=run_all)


def run_all(args: argparse.Namespace) -> None:
    """Run all cases, or with ``--resume`` those that the file of results lacks, and report."""
    for scene in args.scenes:
        if scene not in SCENE_NAMES:
            raise GraphvioError(f"there is no scene {scene!r}; choose from {', '.join(SCENE_NAMES)}")
    if args.seeds < 1 or args.first_seed < 0:
        raise GraphvioError("--seeds must be at least 1, and --first-seed not negative")
    if args.no_imu and not set(args.pairs) & set(_PAIRS):
        raise GraphvioError("--no-imu leaves nothing to run: without a pair, only the IMU shows the scale")
    levels = [*([] if args.no_exact else [EXACT]), *args.levels]
    errors = {level: _error(level, args.components) for level in levels}
    config = _config(args.config, args.set)
    report = Report()
    report.add(machine())
    results: dict[Case, CalibrationOutcome] = {}
    known = load_outcomes(args.out) if args.resume else {}
    try:
        for scene in args.scenes:
            folder = _rendered(args, scene)
            chosen = _choices(folder, args.pairs)
            for level, seed in _draws(levels, args.first_seed, args.seeds):
                cases = list(_cases(args, scene, level, seed, chosen))
                results |= {case: known[case.key] for case in cases if case.key in known}
                missing = [case for case in cases if case.key not in known]
                if not missing:
                    continue
                walk = WronglyCalibrated(folder, scene, args.duration, args.rig_change, errors[level], seed)
                for case in missing:
                    results[case] = walk.run(config, partial(_selected, case=case))
                    append_outcome(args.out, case, results[case])
                    print(_line(case, results[case]), flush=True)
    except KeyboardInterrupt:
        log_progress("interrupted; the tables show what was done")
        args.docs = False
    _tables(report, results)
    if args.docs:
        report.save_to_docs(_docs_table(set(args.pairs)))


def _docs_table(pairs: set[str]) -> str:
    """Return the name of the table in the docs for the choices of cameras that were run."""
    if "front+single" in pairs:
        return "calibration-error-beside"
    return "calibration-error" if pairs & set(_PAIRS) else "calibration-error-singles"


def _rendered(args: argparse.Namespace, scene: str) -> Path:
    """Return the folder of a scene's recording, with exact files."""
    if args.recordings is None:
        return simulated(args.data, scene, args.duration, args.rig_change)
    folder: Path = args.recordings / (scene if args.rig_change is None else f"{scene}-{args.rig_change}")
    if not folder.is_dir():
        change = "" if args.rig_change is None else f" --rig-change {args.rig_change}"
        raise GraphvioError(f"{folder}: is not there; make it by  graphvio simulate {scene} --out {folder}{change}")
    return folder


def _error(level: int, components: Sequence[str] | None) -> CalibrationErrorSizes:
    return CalibrationErrorSizes() if level == EXACT else CalibrationErrorSizes.of_level(level, components)


def _config(profile: str, assignments: Sequence[str]) -> Config:
    """Load a profile and change values by assignments such as ``smoother.lag_s=3``."""
    values = yaml.safe_load(Config.load(profile).to_yaml())
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        stage, dot, key = name.partition(".")
        if not (equals and dot and stage and key):
            raise GraphvioError(f"--set {assignment}: give stage.name=value, such as smoother.lag_s=3")
        values.setdefault(stage, {})[key] = yaml.safe_load(value)
    return Config.from_yaml(yaml.safe_dump(values), "--set")


def _draws(levels: Sequence[int], first_seed: int, seeds: int) -> Iterator[tuple[int, int]]:
    """Yield the level and the seed of each sampled calibration error; for exact files there is only one."""
    for level in levels:
        for seed in range(first_seed, first_seed + (1 if level == EXACT else seeds)):
            yield level, 0 if level == EXACT else seed


def _choices(folder: Path, pairs: Sequence[str]) -> list[str]:
    """Return the choices of cameras that are possible in a recording; with a single pair, ``both`` means this pair."""
    if len(open_source(folder).rig.pairs) > 1:
        return list(pairs)
    return [each for each in pairs if each in (_BOTH, "none", "one-camera")]


def _cases(args: argparse.Namespace, scene: str, level: int, seed: int, chosen: Sequence[str]) -> Iterator[Case]:
    duration = "whole" if args.duration is None else f"{args.duration:g}"
    components = "all" if args.components is None or level == EXACT else " ".join(sorted(args.components))
    config = " ".join([args.config, *sorted(args.set)])
    for imu in ("yes", "no"):
        if (imu == "yes" and args.no_imu) or (imu == "no" and args.imu):
            continue
        for pairs in chosen:
            if imu == "no" and pairs in _SINGLES:
                continue
            yield Case(scene, duration, args.rig_change or "none", level, components, seed, config, pairs, imu)


def _selected(rig: Rig, case: Case) -> Rig:
    """Return the part of a rig that a case uses."""
    n_cameras = {"one-camera": 1, "front+single": 3}.get(case.pairs)
    if n_cameras is not None:
        return rig.with_only([camera.name for camera in rig.cameras[:n_cameras]])
    chosen = rig.without_pairs() if case.pairs == "none" else rig.with_pairs(_PAIRS[case.pairs][: len(rig.pairs)])
    return chosen if case.imu == "yes" else chosen.without_imu()


def _line(case: Case, outcome: CalibrationOutcome) -> str:
    draw = "exact files" if case.level == EXACT else f"level {case.level}, {case.components}, seed {case.seed}"
    posed = "" if outcome.posed_percent > 99.0 else f", {outcome.posed_percent:.0f} % with pose"
    epochs = "" if outcome.epochs == 1 else f", {outcome.epochs} epochs"
    change = "" if case.rig_change == "none" else f", {case.rig_change}"
    return (
        f"{case.scene}{change}, {draw}: {case.pairs}, {'with' if case.imu == 'yes' else 'without'} IMU: "
        f"ATE {100 * outcome.ate_m:.2f} cm, {100 * outcome.ate_scaled_m:.2f} cm but for its scale"
        f"{epochs}{posed}, NEES {outcome.pose_nees:.2f} of each dimension, "
        f"{outcome.frameset_ms:.1f} ms a frameset"
    )


def _tables(report: Report, results: dict[Case, CalibrationOutcome]) -> None:
    """Add the tables of accuracy by scene and level, and of the parameters' errors before and after estimation."""
    of_pairs = {case: outcome for case, outcome in results.items() if case.pairs in _PAIRS}
    of_singles = {case: outcome for case, outcome in results.items() if case.pairs in _SINGLES}
    if of_pairs:
        _tables_of_pairs(report, of_pairs)
    if of_singles:
        _tables_of_singles(report, of_singles)


def _tables_of_pairs(report: Report, results: Mapping[Case, CalibrationOutcome]) -> None:
    by_group: dict[tuple[str, int, str], dict[str, dict[int, CalibrationOutcome]]] = {}
    for case, outcome in results.items():
        of_pairs = by_group.setdefault((case.scene, case.level, case.imu), {pairs: {} for pairs in _PAIRS})
        of_pairs[case.pairs][case.seed] = outcome
    rows, parameter_rows = [], []
    for (scene, level, imu), runs in by_group.items():
        here = [scene, _level_text(level), imu]
        exact = by_group.get((scene, EXACT, imu))
        rows.append([*here, *_accuracy_cells(runs, exact[_BOTH].get(0) if exact is not None else None)])
        both = list(runs[_BOTH].values())
        if _are_wrong(both):
            parameter_rows.append([*here, *(_before_after(both, name) for name in _PARAMETERS)])
    report.add(
        "### Accuracy",
        "ATE in cm and ratio to the better single pair: median / worst of the draws. Ratio to the exact files: of the "
        "medians. But for scale: after alignment with scale, of both pairs, and the error of their scale, which is "
        "that of the files' baselines where the accelerometer does not show it. Pose NEES: of poses since the first "
        "one, by all pairs, 1 where covariances are right. With pose: framesets of the worst draw, by all pairs.",
    )
    head = [
        "scene",
        "level",
        "IMU",
        "draws",
        *_PAIRS,
        "both, but for scale",
        "scale of both, %",
        "both / exact files",
        "both / better single",
        "pose NEES / 6",
        "with pose, %",
    ]
    report.table(head, rows)
    _table_of_parameters(report, "with both pairs", ["scene", "level", "IMU", *_PARAMETERS.values()], parameter_rows)


def _tables_of_singles(report: Report, results: Mapping[Case, CalibrationOutcome]) -> None:
    by_group: dict[tuple[str, str, int], list[CalibrationOutcome]] = {}
    for case, outcome in results.items():
        by_group.setdefault((case.scene, case.pairs, case.level), []).append(outcome)
    rows, parameter_rows = [], []
    for (scene, cameras, level), runs in by_group.items():
        here = [scene, _SINGLES[cameras], _level_text(level)]
        exact = by_group.get((scene, cameras, EXACT))
        rows.append(
            [
                *here,
                f"{len(runs)}",
                _median_and_worst([100 * run.ate_m for run in runs]),
                f"{median(run.ate_m for run in runs) / exact[0].ate_m:.2f}" if exact is not None else "-",
                _median_and_worst([run.pose_nees for run in runs]),
                f"{min(run.posed_percent for run in runs):.0f}",
                f"{max(run.epochs for run in runs)}",
            ]
        )
        if _are_wrong(runs):
            parameter_rows.append([*here, *(_before_after(runs, name) for name in _PARAMETERS_OF_SINGLES)])
    report.add(
        "### Accuracy of single cameras",
        "With the IMU. ATE in cm: median / worst of the draws. Ratio to the exact files: of the medians. Pose NEES: of "
        "poses since the first one, 1 where covariances are right. With pose: framesets of the worst draw, and "
        "none before the scale is known. Epochs: most of a draw.",
    )
    head = ["scene", "cameras", "level", "draws", "ATE, cm", "/ exact files", "pose NEES / 6", "with pose, %", "epochs"]
    report.table(head, rows)
    columns = ["scene", "cameras", "level", *_PARAMETERS_OF_SINGLES.values()]
    _table_of_parameters(report, "with single cameras", columns, parameter_rows)


def _table_of_parameters(report: Report, by: str, head: list[str], rows: list[list[str]]) -> None:
    """Add the table of the parameters that the odometry estimated with some cameras, unless all files were exact."""
    if not rows:
        return
    report.add(
        f"### Calibration parameters {by}",
        "Rms errors of the files -> of the rig that the odometry estimated; medians of the draws.",
    )
    report.table(head, rows)


def _level_text(level: int) -> str:
    return "exact" if level == EXACT else f"{level}"


def _are_wrong(outcomes: Sequence[CalibrationOutcome]) -> bool:
    return any(error > _ROUNDING for outcome in outcomes for error in outcome.before.values())


def _accuracy_cells(runs: dict[str, dict[int, CalibrationOutcome]], exact: CalibrationOutcome | None) -> list[str]:
    """Return the cells of a row from the number of samples on; ``runs`` is choice of pairs -> seed -> outcome."""
    both, front, back = (runs[pairs] for pairs in _PAIRS)
    against_exact = "-"
    if both and exact is not None:
        against_exact = f"{median(run.ate_m for run in both.values()) / exact.ate_m:.2f}"
    against_single = [
        run.ate_m / min(front[seed].ate_m, back[seed].ate_m)
        for seed, run in both.items()
        if seed in front and seed in back
    ]
    return [
        f"{max(len(each) for each in runs.values())}",
        *(_median_and_worst([100 * run.ate_m for run in each.values()]) for each in (both, front, back)),
        _median_and_worst([100 * run.ate_scaled_m for run in both.values()]),
        _median_and_worst([abs(run.scale_error_percent) for run in both.values()]),
        against_exact,
        _median_and_worst(against_single),
        _median_and_worst([run.pose_nees for run in both.values()]),
        f"{min(run.posed_percent for run in both.values()):.0f}" if both else "-",
    ]


_PARAMETERS = {
    "focal_percent": "f, %",
    "principal_point_px": "c, px",
    "distortion_percent": "k, %",
    "left_right_deg": "left-right, deg",
    "baseline_percent": "baseline, %",
    "pair_transform_deg": "P_12, deg",
    "pair_transform_mm": "P_12, mm",
    "cameras_in_body_deg": "in body, deg",
    "cameras_in_body_mm": "in body, mm",
    "time_offset_ms": "offset, ms",
}

_PARAMETERS_OF_SINGLES = {
    name: text.replace("P_12", "between cameras")
    for name, text in _PARAMETERS.items()
    if name not in ("left_right_deg", "baseline_percent")
}


def _before_after(outcomes: Sequence[CalibrationOutcome], name: str) -> str:
    before = [outcome.before[name] for outcome in outcomes if name in outcome.before]
    after = [outcome.after[name] for outcome in outcomes if name in outcome.after]
    return f"{_figure(before)} -> {_figure(after)}" if before else "-"


def _figure(values: Sequence[float]) -> str:
    return f"{round(median(values), 6):.2g}" if values else "-"


def _median_and_worst(values: Sequence[float]) -> str:
    return f"{median(values):.2f} / {max(values):.2f}" if values else "-"

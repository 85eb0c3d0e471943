from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest
import yaml

from graphvio.config import Config, profiles
from graphvio.config.stages import MotionConfig, SmootherConfig
from graphvio.errors import ConfigError


def test_round_trip_through_yaml(tmp_path: Path) -> None:
    config = Config(motion=MotionConfig(selection="best_pair", hypotheses=77, pixel_sigma_px=0.123456789012345))
    assert Config.from_yaml(config.to_yaml()) == config
    path = tmp_path / "own.yaml"
    path.write_text(config.to_yaml())
    assert Config.load(path) == config
    assert Config.load(str(path)) == config


@pytest.mark.parametrize("text", ["", "{}", "# nothing\n", "motion:\n", "motion: {}\n"])
def test_from_yaml_keeps_defaults_of_missing_values(text: str) -> None:
    assert Config.from_yaml(text) == Config()


def test_from_yaml_of_one_value_keeps_the_others() -> None:
    assert Config.from_yaml("motion: {seed: 3}") == Config(motion=MotionConfig(seed=3))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("moton: {}", "motion"),
        ("smother: {}", "smoother"),
        ("motion: {hypothesis: 3}", "hypotheses"),
        ("corners: {cells_accross: 3}", "cells_across"),
        ("smoother: {lag: 3}", "lag_s"),
    ],
)
def test_unknown_key_error_names_the_nearest_one(text: str, named: str) -> None:
    with pytest.raises(ConfigError, match=f"unknown key .*did you mean '{named}'"):
        Config.from_yaml(text)


def test_unknown_key_error_without_a_near_one_names_the_command_that_shows_all() -> None:
    with pytest.raises(ConfigError, match=r"motion: unknown key 'colour'; graphvio dump-config shows all$"):
        Config.from_yaml("motion: {colour: 3}")


@pytest.mark.parametrize(
    "value",
    [
        "motion: {pixel_sigma_px: -0.1}",
        "motion: {pixel_sigma_px: .nan}",
        "motion: {pixel_sigma_px: .inf}",
        "motion: {pixel_sigma_px: '0.3'}",
        "motion: {pixel_sigma_px: true}",
        "motion: {pixel_sigma_px: }",
        "motion: {pixel_sigma_px: [0.3]}",
        "motion: {hypotheses: -1}",
        "motion: {hypotheses: 2.5}",
        "motion: {hypotheses: true}",
        "motion: {hypotheses: many}",
        "motion: {selection: both}",
        "motion: {selection: 1}",
        "motion: {selection: [joint]}",
        "motion: 3",
        "motion: [selection]",
    ],
)
def test_bad_value_error_says_where(value: str) -> None:
    with pytest.raises(ConfigError, match=r"my\.yaml: motion"):
        Config.from_yaml(value, "my.yaml")


@pytest.mark.parametrize(
    "value", ["motion: {hypotheses: .nan}", "motion: {hypotheses: .inf}", f"motion: {{pixel_sigma_px: 1{400 * '0'}}}"]
)
def test_numbers_too_large_are_rejected(value: str) -> None:
    with pytest.raises(ConfigError, match=r"my\.yaml: motion"):
        Config.from_yaml(value, "my.yaml")


@pytest.mark.parametrize(
    "value",
    [
        "corners: {cells_across: 0}",
        "tracking: {window_px: 0}",
        "tracking: {levels: 0}",
        "stereo: {min_depth_m: 0}",
        "motion: {pixel_sigma_px: 0}",
        "motion: {cauchy_scale_px: 0}",
        "motion: {chunk_points: 0}",
        "motion: {sigma_inflation: 0}",
        "smoother: {gate_probability: 1.5}",
        "smoother: {imu_noise_scale: 0}",
        "motion: {min_inliers: 0}",
    ],
)
def test_values_out_of_range_are_rejected(value: str) -> None:
    with pytest.raises(ConfigError):
        Config.from_yaml(value)


@pytest.mark.parametrize(
    ("stage", "name", "least", "most"),
    [
        ("corners", "cells_across", 2, 100),
        ("tracking", "window_px", 5, 63),
        ("tracking", "levels", 1, 8),
        ("motion", "min_inliers", 3, 1000),
    ],
)
def test_error_out_of_range_states_the_range(stage: str, name: str, least: int, most: int) -> None:
    for value in (least, most):
        assert getattr(getattr(Config.from_yaml(f"{stage}: {{{name}: {value}}}"), stage), name) == value
    for value in (least - 1, most + 1):
        expected = "it must be positive" if value == 0 else f"choose from {least} to {most}"
        with pytest.raises(ConfigError, match=f"{name}: is {value}; {expected}"):
            Config.from_yaml(f"{stage}: {{{name}: {value}}}")


@pytest.mark.parametrize("text", ["motion: {", "3", "- motion", "just words"])
def test_from_yaml_of_no_mapping_is_rejected(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^my\.yaml: "):
        Config.from_yaml(text, "my.yaml")


def test_unknown_profile_and_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'paper'"):
        Config.load("papper")
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read \(No such file or directory\); give"):
        Config.load(tmp_path / "none.yaml")
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match="is not a text file"):
        Config.load(binary)


def test_every_profile_loads() -> None:
    folder = Path(__file__).parents[1] / "configs"
    assert set(profiles()) == {path.stem for path in folder.glob("*.yaml")}
    assert {"default", "paper", "fast"} <= set(profiles())
    loaded = {name: Config.load(name) for name in profiles()}
    assert loaded["default"] == Config()
    assert loaded["paper"].motion.selection == "best_pair"
    assert loaded["paper"].motion.residuals == "per_image"
    assert loaded["paper"].fusion.estimator == "filter"


@pytest.mark.parametrize("text", ["{estimator: filter}", "{estimate_time_offset: true}\nmotion: {reference: previous}"])
def test_stages_that_do_not_fit_together_are_rejected(text: str) -> None:
    with pytest.raises(ConfigError, match=r"set motion: {reference: (previous|keyframe)}"):
        Config.from_yaml(f"fusion: {text}")


@pytest.mark.parametrize("value", ["1", "yes please", "[true]"])
def test_switch_must_be_true_or_false(value: str) -> None:
    with pytest.raises(ConfigError, match=r"estimate_time_offset: is .*; it must be true or false"):
        Config.from_yaml(f"fusion: {{estimate_time_offset: {value}}}")


def another(value: object) -> object:
    """Another value in the same range."""
    if isinstance(value, str):
        return {
            "joint": "best_pair", "previous": "keyframe", "per_point": "per_image", "smoother": "filter",
            "estimated": "none", "orb": "sift",
        }[value]  # fmt: skip
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value - 1 if value else 1
    if value is None:
        return 3.0
    assert isinstance(value, float)
    return 0.5 * value or 0.1


def test_sha256_differs_with_every_value() -> None:
    config = Config.from_yaml("motion: {reference: previous}")  # suits both estimators
    assert config.sha256() == Config.from_yaml("motion: {reference: previous}").sha256() != Config().sha256()
    assert Config().sha256() == Config.from_yaml("motion: {min_inliers: 12.0, max_error_px: 3}").sha256()
    digests = {config.sha256()}
    for stage in fields(Config):
        settings = getattr(config, stage.name)
        for name, value in asdict(settings).items():
            other = another(value)
            before = Config() if name == "estimate_time_offset" else config  # it needs keyframes
            digests.add(replace(before, **{stage.name: replace(settings, **{name: other})}).sha256())
    values = [v for section in yaml.safe_load(config.to_yaml()).values() for v in section.values()]
    assert len(digests) == 1 + len(values)


def test_values_are_checked_in_python_as_in_files() -> None:
    with pytest.raises(ConfigError, match="SmootherConfig: lag_s: is 0; it must be positive"):
        SmootherConfig(lag_s=0.0)
    with pytest.raises(ConfigError, match=r"MotionConfig: selection: is 'bets_pair'; choose one of"):
        MotionConfig(selection="bets_pair")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="must be a number"):
        replace(SmootherConfig(), lag_s="long")  # type: ignore[arg-type]
    assert Config(motion=MotionConfig(min_inliers=12.0)).sha256() == Config().sha256()  # type: ignore[arg-type]


def test_numbers_without_a_point_before_the_exponent_are_numbers() -> None:
    """YAML 1.1 takes them for text."""
    config = Config.from_yaml("motion: {calibration_error_share: 1e-9}")
    assert config.motion.calibration_error_share == 1e-9
    with pytest.raises(ConfigError, match="is '1e-9x'; it must be a number"):
        Config.from_yaml("motion: {calibration_error_share: 1e-9x}")
    assert Config.from_yaml("smoother: {lag_s: 1.5e0}\ntracking: {levels: 3e0}").tracking.levels == 3

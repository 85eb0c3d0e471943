"""The configuration of all stages, and its reading from profiles and YAML files.

A profile is a YAML file in ``configs/`` that overrides some of the default values. A user's own file works the same.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, field
from pathlib import Path

from graphvio.config.stages import (
    CalibrationConfig,
    CornerConfig,
    FilterConfig,
    FusionConfig,
    InitialisationConfig,
    KeyframesConfig,
    LiveConfig,
    MotionConfig,
    OptimizationConfig,
    SmootherConfig,
    StereoConfig,
    TimingConfig,
    TrackingConfig,
)
from graphvio.config.values import build
from graphvio.errors import ConfigError
from graphvio.wording import nearest


@dataclass(frozen=True)
class Config:
    """Configuration of all stages, one attribute for each stage."""

    corners: CornerConfig = field(default_factory=CornerConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    initialisation: InitialisationConfig = field(default_factory=InitialisationConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)
    timing: TimingConfig = field(default_factory=TimingConfig)
    optimization: OptimizationConfig = field(default_factory=OptimizationConfig)
    keyframes: KeyframesConfig = field(default_factory=KeyframesConfig)
    live: LiveConfig = field(default_factory=LiveConfig)

    def __post_init__(self) -> None:
        """Check that the values of different stages are compatible.

        Raises:
            ConfigError: if they are not.
        """
        if self.fusion.estimator == "filter" and self.motion.reference != "previous":
            raise ConfigError(
                "fusion: estimator filter measures velocities over one step; set motion: {reference: previous}"
            )
        if self.fusion.estimate_time_offset and self.motion.reference == "previous":
            raise ConfigError(
                "fusion: estimate_time_offset compares rotations over a quarter of a second; set motion: "
                "{reference: keyframe}"
            )

    @property
    def estimates_calibration(self) -> bool:
        """Whether the calibration is estimated while the odometry runs.

        This needs motion that is measured from keyframes: tracks that are followed from frame to frame all drift in a
        similar way, which would be taken for an error of the cameras.
        """
        return self.calibration.online and self.motion.reference == "keyframe"

    @staticmethod
    def load(name_or_path: str | Path) -> Config:
        """Read a configuration from a profile or a YAML file.

        Args:
            name_or_path: name of a profile, or path of a YAML file (.yaml or .yml) with the values to change.

        Returns:
            The configuration; values that the file does not set have their default.

        Raises:
            ConfigError: if there is no such profile or file, or a key or value in it is not valid.
        """
        path = Path(name_or_path)
        if path.suffix not in (".yaml", ".yml"):
            known = profiles()
            if str(name_or_path) not in known:
                raise ConfigError(
                    f"no profile {str(name_or_path)!r}{nearest(str(name_or_path), known)}; profiles are "
                    f"{', '.join(sorted(known))}, and a file ends in .yaml"
                )
            path = known[str(name_or_path)]
        try:
            text = path.read_text()
        except OSError as error:
            raise ConfigError(
                f"{path}: cannot be read ({error.strerror}); give a YAML file or a profile's name"
            ) from None
        except UnicodeDecodeError:
            raise ConfigError(f"{path}: is not a text file; give a YAML file or a profile's name") from None
        return Config.from_yaml(text, str(path))

    @staticmethod
    def from_yaml(text: str, where: str = "configuration") -> Config:
        """Parse a configuration in YAML; missing values keep their default.

        Args:
            text: the YAML text: a mapping of stages to mappings of names to values.
            where: where the text was read, such as a file's path; for error messages.

        Returns:
            The configuration.

        Raises:
            ConfigError: if the text is no YAML mapping, or a key or value is not valid.
        """
        import yaml

        try:
            data = yaml.safe_load(text)
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            line = "" if mark is None else f"line {mark.line + 1} "
            problem = getattr(error, "problem", None) or str(error).partition("\n")[0]
            raise ConfigError(f"{where}: {line}is not valid YAML ({problem}); correct it there") from None
        config: Config = build(Config, {} if data is None else data, where)
        return config

    def to_yaml(self) -> str:
        """Return all values as YAML, in the order of the dataclasses."""
        import yaml

        text: str = yaml.safe_dump(asdict(self), sort_keys=False)
        return text

    def sha256(self) -> str:
        """Return the SHA-256 digest of all values, in hexadecimal; equal configurations have equal digests."""
        return hashlib.sha256(self.to_yaml().encode()).hexdigest()


def profiles() -> dict[str, Path]:
    """Return the profiles that come with graphvio: name -> YAML file."""
    here = Path(__file__).parent.parent
    for folder in (here / "configs", here.parent / "configs"):  # in an installed package, in a checkout
        if folder.is_dir():
            return {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    return {}

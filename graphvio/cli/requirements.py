"""The packages without which no command runs; pip installs them, but environments are made in other ways, too."""

from importlib.util import find_spec

from graphvio.errors import MissingRequirementError

REQUIRED = {
    "gtsam": "gtsam",
    "numpy": "numpy",
    "numba": "numba",
    "scipy": "scipy",
    "cv2": "opencv-python-headless",
    "matplotlib": "matplotlib",
    "yaml": "pyyaml",
    "isal": "isal",
    "jinja2": "jinja2",
    "rich": "rich",
}
"""Module -> the package that has it."""


def check_requirements() -> None:
    """Check that all are there, before hours of work end at a plot.

    Raises:
        MissingRequirementError: if one is not.
    """
    absent = [package for module, package in REQUIRED.items() if find_spec(module) is None]
    if absent:
        raise MissingRequirementError(absent)

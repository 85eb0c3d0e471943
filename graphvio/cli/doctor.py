"""``graphvio doctor``: shows what is installed on this machine; and a check of the packages that all commands need."""

import os
import platform
import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from graphvio.cli.json_output import publish
from graphvio.errors import MissingRequirementError
from graphvio.runtime import usable_cores

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
"""Module that all commands need -> the package that contains it."""

_OPENCV = ("opencv-python-headless", "opencv-contrib-python-headless", "opencv-python", "opencv-contrib-python")
_OPTIONAL = {
    "viewer": ("rerun", "rerun-sdk", "live view and recordings"),
    "maps": ("pycolmap", "pycolmap", "loops and COLMAP models"),
    "sessions": ("mcap", "mcap", "MCAP sessions and bags"),
    "fleet": ("distributed", "dask", "many sessions side by side"),
    "s3": ("s3fs", "s3fs", "sessions on S3"),
    "live": ("prometheus_client", "prometheus-client", "metrics and serial IMUs"),
    "realsense": ("pyrealsense2", "pyrealsense2", "RealSense cameras"),
    "oak": ("depthai", "depthai", "OAK cameras"),
    "ros2": ("cyclonedds", "cyclonedds", "ROS 2 topics"),
    "serve": ("grpc", "grpcio", "gRPC"),
}


def check_requirements() -> None:
    """Check that all required packages are installed, so that none is found missing only after hours of work.

    Raises:
        MissingRequirementError: if a package is missing.
    """
    absent = [package for module, package in REQUIRED.items() if find_spec(module) is None]
    if absent:
        raise MissingRequirementError(absent)


def doctor() -> None:
    """Show what graphvio finds on this machine: versions, cores, optional parts, compiled kernels.

    Examples:

        graphvio doctor

        graphvio doctor --json
    """
    findings = examine()
    publish(findings)
    from rich.console import Console

    Console(soft_wrap=True).print(_table(findings))


def _table(findings: dict[str, Any]) -> Any:
    from rich.markup import escape
    from rich.table import Table

    table = Table(show_header=False)
    for name, version in findings["versions"].items():
        table.add_row(name, version or "[red]missing[/red]: pip install graphvio")
    table.add_section()
    table.add_row("cores", f"{findings['cores']['usable']} of {findings['cores']['present']} usable")
    table.add_section()
    for name, part in findings["optional"].items():
        absent = escape(f"absent ({part['purpose']}): {part['install']}")
        table.add_row(f"optional: {name}", part["version"] or absent)
    table.add_section()
    cache = findings["kernel_cache"]
    table.add_row("kernel cache", f"{escape(cache['folder'])}, {cache['files']} files, {cache['megabytes']:.1f} MB")
    if cache["shared_folder"]:
        table.add_row("", f"{escape(cache['shared_folder'])} is read, too")
    modules = cache["compiled_modules"]
    missing = "" if all(modules.values()) else "; the others compile when first used"
    if not any(modules.values()):
        missing = "; graphvio warmup compiles those of the odometry, in about a minute"
    table.add_row("modules compiled", f"{sum(modules.values())} of {len(modules)}{missing}")
    return table


def examine() -> dict[str, Any]:
    """Return the findings of ``graphvio doctor``, in types that JSON has."""
    from graphvio.kernel_cache import any_compiled_before, cache_root, shared_root
    from graphvio.version import __version__

    folder, shared = cache_root(), shared_root()
    kernels = [file.stat().st_size for file in folder.rglob("*.nbc")]
    versions: dict[str, str | None] = {"graphvio": __version__, "python": platform.python_version()}
    versions |= {package: _version(package) if find_spec(module) else None for module, package in REQUIRED.items()}
    del versions["opencv-python-headless"]  # only one of several packages that contain cv2
    versions["opencv"] = next((version for name in _OPENCV if (version := _version(name))), None)
    return {
        "versions": versions,
        "platform": platform.platform(),
        "executable": sys.executable,
        "cores": {"present": os.cpu_count() or 1, "usable": usable_cores()},
        "optional": {
            name: {
                "version": _version(package) if find_spec(module) else None,
                "purpose": purpose,
                "install": f"pip install 'graphvio[{name}]'",
            }
            for name, (module, package, purpose) in _OPTIONAL.items()
        },
        "kernel_cache": {
            "folder": str(folder),
            "files": len(kernels),
            "megabytes": sum(kernels) / 1e6,
            "shared_folder": str(shared) if shared else None,
            "compiled_modules": {module: any_compiled_before(module) for module in kernel_modules()},
        },
    }


def kernel_modules() -> list[str]:
    """Return the names of the modules with kernels. Their text is searched, since an import would compile some."""
    import graphvio

    package = Path(graphvio.__file__).parent
    found = []
    for file in sorted(package.rglob("*.py")):
        if re.search(r"^@(fast_|vector_)?kernel$", file.read_text(encoding="utf-8"), re.MULTILINE):
            parts = file.relative_to(package.parent).with_suffix("").parts
            found.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return found


def _version(package: str) -> str | None:
    from importlib import metadata

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None

"""The command line of ``scripts/benchmark``: every subcommand is a module with ``add_parser(subparsers)``."""

import sys

from benchmarks import (
    accuracy,
    backend,
    calibration_error,
    cameras,
    decoding,
    faults,
    frontend,
    lenses,
    optimize,
    slam,
    stages,
    startup,
    walk,
)
from benchmarks.command_line import run_command_line

if __name__ == "__main__":
    sys.exit(
        run_command_line(
            "scripts/benchmark",
            "Measures speed, accuracy and behaviour under faults. docs/explanation/benchmarks has what is compared.",
            tuple(
                module.add_parser
                for module in (
                    startup,
                    frontend,
                    stages,
                    decoding,
                    backend,
                    accuracy,
                    walk,
                    calibration_error,
                    cameras,
                    lenses,
                    faults,
                    optimize,
                    slam,
                )
            ),
            "Timings mean something only on a machine that does nothing else meanwhile.",
        )
    )

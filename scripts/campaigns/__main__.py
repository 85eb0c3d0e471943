"""The command line of ``scripts/campaign``: every subcommand is a module with ``add_parser(subparsers)``."""

import sys

from benchmarks.command_line import run_command_line

from campaigns import (
    calibration,
    consistency,
    endurance,
    lags,
    live,
    mapping,
    outages,
    random_rigs,
    rates,
    real_imu,
    self_calibration,
    soak,
)  # fmt: skip

_MODULES = (
    consistency, real_imu, outages, endurance, rates, lags, calibration, self_calibration, random_rigs, live, soak,
    mapping,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(
        run_command_line(
            "scripts/campaign",
            "Monte Carlo campaigns and outages. docs/explanation/benchmarks has their results.",
            tuple(module.add_parser for module in _MODULES),
        )
    )

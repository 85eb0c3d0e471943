"""The command line of ``scripts/campaign``: every subcommand is a module with ``add_parser(subparsers)``."""

import argparse
import sys

from benchmarks.__main__ import EXIT_BAD_INPUT, EXIT_INTERRUPTED

from campaigns import consistency, lags
from graphvio.errors import GraphvioError

SUBCOMMANDS = (consistency, lags)


def main() -> int:
    """Parse, run, and turn a user's mistake into one line and exit code 2."""
    parser = argparse.ArgumentParser(
        prog="scripts/campaign",
        description="Statistical claims by Monte Carlo. docs/benchmarks.md has their results.",
    )
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for subcommand in SUBCOMMANDS:
        subcommand.add_parser(subparsers)
    args = parser.parse_args()
    try:
        args.run(args)
    except GraphvioError as error:
        print(f"scripts/campaign: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("scripts/campaign: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())

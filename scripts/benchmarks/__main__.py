"""The command line of ``scripts/benchmark``: every subcommand is a module with ``add_parser(subparsers)``."""

import argparse
import sys

from benchmarks import accuracy, faults, frontend
from graphvio.errors import GraphvioError

SUBCOMMANDS = (frontend, accuracy, faults)

EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130


def main() -> int:
    """Parse, run, and turn a user's mistake into one line and exit code 2."""
    parser = argparse.ArgumentParser(
        prog="scripts/benchmark",
        description="Measures speed, accuracy and behaviour under faults. docs/benchmarks.md tells what is compared.",
        epilog="Timings mean something only on a machine that does nothing else meanwhile.",
    )
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for subcommand in SUBCOMMANDS:
        subcommand.add_parser(subparsers)
    args = parser.parse_args()
    try:
        args.run(args)
    except GraphvioError as error:
        print(f"scripts/benchmark: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("scripts/benchmark: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Parts that the command lines of ``scripts/benchmark`` and ``scripts/campaign`` share."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

from graphvio.errors import GraphvioError

EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130


Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
AddParser: TypeAlias = Callable[[Subparsers], None]
"""A function that adds a subcommand's parser; the parser's default ``run`` is called with the parsed arguments."""


def add_command(
    subparsers: Subparsers, name: str, summary: str, description: str | None, run: Callable[[argparse.Namespace], None]
) -> argparse.ArgumentParser:
    """Add a subcommand whose help is a module's docstring, shown with its line breaks."""
    parser = subparsers.add_parser(
        name, help=summary, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.set_defaults(run=run)
    return parser


def run_command_line(prog: str, description: str, subcommands: Sequence[AddParser], epilog: str = "") -> int:
    """Parse the arguments and run the subcommand; an invalid input gives a one-line message and exit code 2."""
    parser = argparse.ArgumentParser(prog=prog, description=description, epilog=epilog)
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for add_parser in subcommands:
        add_parser(subparsers)
    args = parser.parse_args()
    try:
        args.run(args)
    except GraphvioError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def add_report_options(parser: argparse.ArgumentParser) -> None:
    """Add the options ``--out`` and ``--docs``, with which the report is also written to a file or to the docs."""
    parser.add_argument("--out", type=Path, metavar="FILE.md", help="write the report to this file")
    parser.add_argument("--docs", action="store_true", help="write the report into docs/explanation/benchmarks")

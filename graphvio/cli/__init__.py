"""The command line: one module per command; what is heavy is imported inside the command."""

import sys

import typer

from graphvio.cli.doctor import doctor
from graphvio.cli.dump_config import dump_config
from graphvio.cli.evaluate import evaluate
from graphvio.cli.run import run
from graphvio.cli.simulate import simulate
from graphvio.cli.view import view
from graphvio.errors import GraphvioError

EXIT_BAD_INPUT = 2

app = typer.Typer(
    name="graphvio",
    help="Visual-inertial odometry for rigs of several stereo pairs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
app.command()(run)
app.command()(evaluate)
app.command()(simulate)
app.command()(view)
app.command(name="dump-config")(dump_config)
app.command()(doctor)


def main() -> None:
    """Entry point: a user's mistake becomes one line and exit code 2; ``--verbose`` shows the traceback."""
    try:
        app()
    except GraphvioError as error:
        if "--verbose" in sys.argv:
            raise
        print(f"graphvio: {error}", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)

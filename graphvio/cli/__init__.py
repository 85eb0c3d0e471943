"""The command line, with one module per command; heavy packages are imported only when a command is called."""

import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer

from graphvio.cli.benchmark import benchmark
from graphvio.cli.calibrate import calibrate, calibrate_trajectories
from graphvio.cli.compare import compare
from graphvio.cli.doctor import check_requirements, doctor
from graphvio.cli.evaluate import evaluate
from graphvio.cli.fleet import fleet
from graphvio.cli.info import dump_config, info
from graphvio.cli.json_output import print_error, with_json
from graphvio.cli.live import live
from graphvio.cli.optimize import optimize
from graphvio.cli.output import lasting_streams
from graphvio.cli.record import convert, record
from graphvio.cli.rig import rig
from graphvio.cli.run import run
from graphvio.cli.serve import serve
from graphvio.cli.shared import EXIT_BAD_INPUT, EXIT_INTERRUPTED, warn
from graphvio.cli.simulate import simulate
from graphvio.cli.slam import slam
from graphvio.cli.view import view
from graphvio.cli.warmup import warmup
from graphvio.errors import GraphvioError
from graphvio.runtime import interruptible, limit_blas_threads
from graphvio.version import __version__

app = typer.Typer(
    name="graphvio",
    help="Visual-inertial odometry for rigs of stereo pairs and single cameras.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # rich alone takes 0.1 s to import
    epilog="Examples:  graphvio simulate room --out room  |  graphvio run room  |  graphvio doctor",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"graphvio {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    if context.invoked_subcommand != "doctor":  # the command that shows which packages are missing
        check_requirements()


def _add(command: Callable[..., Any], name: str | None = None) -> None:
    """Add a command; the list of all commands shows the first paragraph of its docstring in full."""
    app.command(name=name, short_help=(command.__doc__ or "").partition("\n\n")[0])(command)


_add(with_json(run))
_add(with_json(live))
_add(with_json(serve))
_add(with_json(slam))
_add(with_json(calibrate))
_add(with_json(calibrate_trajectories), "calibrate-trajectories")
_add(with_json(rig))
_add(with_json(optimize))
app.add_typer(fleet, name="fleet", short_help=fleet.info.help)
_add(with_json(record))
_add(with_json(convert))
_add(with_json(info))
_add(with_json(evaluate))
_add(with_json(compare))
_add(with_json(benchmark))
_add(with_json(simulate))
_add(view)
_add(with_json(dump_config), "dump-config")
_add(with_json(doctor))
_add(with_json(warmup))


def main() -> None:
    """Run the program. Errors of the input become one line and exit code 2; ``--verbose`` also shows the traceback."""
    limit_blas_threads()  # no module of the command line has imported numpy by now
    with lasting_streams() as output:
        code = _run()
        if output is not None:
            output.flush()
            if output.error is not None and not isinstance(output.error, BrokenPipeError):  # the reader needs no more
                warn(f"standard output cannot be written ({output.error.strerror}); write it to another place")
                code = code or EXIT_BAD_INPUT
    sys.exit(code)


def _run() -> int:
    """Run the command of the command line, and return the exit code."""
    try:
        with interruptible():
            code = app(prog_name="graphvio", standalone_mode=False)
    except (typer.Abort, KeyboardInterrupt):
        print_error("Interrupted", "interrupted")
        return EXIT_INTERRUPTED
    except GraphvioError as error:
        print_error(type(error).__name__, str(error))
        if "--verbose" in sys.argv:
            raise
        return _refuse(str(error))
    except Exception as error:
        usage = getattr(error, "format_message", None)  # only errors of the command-line library have it
        if usage is None:
            print_error(type(error).__name__, str(error))
            raise
        context = getattr(error, "ctx", None)
        if context is not None and usage() == context.get_help():  # no command was given
            typer.echo(usage(), err=True)
            return EXIT_BAD_INPUT
        message = " ".join(usage().split())
        hint = "graphvio --help lists the commands"
        if context is not None and context.parent is not None:
            hint = f"{context.command_path} --help shows its use"
        print_error("UsageError", message)
        return _refuse(f"{message}  ({hint})")
    return code if isinstance(code, int) else 0


def _refuse(message: str) -> int:
    warn(message)
    return EXIT_BAD_INPUT

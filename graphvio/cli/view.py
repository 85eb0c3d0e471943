"""``graphvio view``: shows a result folder in the viewer."""

from pathlib import Path
from typing import Annotated

import typer

from graphvio.cli import options


def view(
    results: Annotated[Path, typer.Argument(help="Result folder that `graphvio run` has written.")],
    save_rrd: Annotated[
        Path | None,
        typer.Option(help="Write a rerun recording here instead of opening a window.", metavar="FILE"),
    ] = None,
    verbose: options.Verbose = False,
) -> None:
    """Show a result folder in the rerun viewer: path, covariance, biases, events.

    If the run has saved a rerun recording (`.rrd`) in the folder, it is opened instead, since it also has the images.

    Examples:

        graphvio view results/corridor-1

        graphvio view results/corridor-1 --save-rrd corridor.rrd
    """
    import subprocess
    import sys

    from graphvio.errors import GraphvioError, MissingExtraError
    from graphvio.viewer import check_display
    from graphvio.viewer.replay import replay

    if not results.is_dir():
        raise GraphvioError(f"{results}: is no folder; give one that  graphvio run  has written")
    if save_rrd is not None:
        replay(results, save=save_rrd)
        typer.echo(f"wrote {save_rrd}")
        return
    check_display()
    recordings = sorted(results.glob("*.rrd"))
    if not recordings:
        replay(results, spawn=True)
        return
    from importlib.util import find_spec

    if find_spec("rerun") is None:
        raise MissingExtraError("rerun-sdk", "viewer", "showing or saving a recording")
    subprocess.Popen([sys.executable, "-m", "rerun", *map(str, recordings)], start_new_session=True)

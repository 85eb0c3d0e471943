"""``graphvio dump-config``: the values of a profile, to start a file of one's own."""

from __future__ import annotations

from typing import Annotated

import typer

from graphvio.cli import options


def dump_config(
    profile: Annotated[str, typer.Argument(help="Profile or YAML file.")] = "default",
    verbose: options.Verbose = False,
) -> None:
    """Print all values of a configuration as YAML.

    Examples:

        graphvio dump-config > mine.yaml

        graphvio dump-config paper
    """
    from graphvio.config import Config

    typer.echo(Config.load(profile).to_yaml(), nl=False)

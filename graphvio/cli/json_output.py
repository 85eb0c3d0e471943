"""The option ``--json`` of commands that print a table or a summary: one document on stdout, and nothing else."""

from __future__ import annotations

import inspect
import io
import json
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from contextvars import ContextVar
from dataclasses import asdict, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from graphvio.cli import options

_Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout, and nothing else.")]
_results: ContextVar[list[object] | None] = ContextVar("results", default=None)


def publish(result: object) -> None:
    """Set the result of a command, which is printed if ``--json`` was given; a later result replaces it."""
    results = _results.get()
    if results is not None:
        results.append(result)


def error_document(kind: str, message: str) -> dict[str, dict[str, str]]:
    """Return the document that ``--json`` prints if a command fails: the error's class and message."""
    return {"error": {"kind": kind, "message": message}}


def print_error(kind: str, message: str) -> None:
    """Print the document of an error if ``--json`` is anywhere on the command line."""
    if "--json" in sys.argv:
        typer.echo(json.dumps(error_document(kind, message), indent=2))


def with_json(command: Callable[..., None]) -> Callable[..., None]:
    """Add ``--json`` to a command that publishes its result; with this option, other output on stdout is suppressed.

    A command that ends with a `typer.Exit` still prints its document; if a command fails, `graphvio.cli.main` prints
    the error. The option ``--verbose`` is added, too; `graphvio.cli.main` looks for it on the command line. A parameter
    whose type is a dataclass of options, see `graphvio.cli.options`, is replaced by these options.
    """
    hints = get_type_hints(command, include_extras=True)
    groups = {name: kind for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)}

    @wraps(command)
    def run(*, verbose: bool = False, as_json: bool = False, **values: Any) -> None:
        """Run the command; with ``as_json``, print only its document."""
        for name, group in groups.items():
            values[name] = group(**{each: values.pop(each) for each in inspect.signature(group).parameters})
        if not as_json:
            command(**values)
            return
        results: list[object] = []
        token = _results.set(results)
        code: typer.Exit | None = None
        try:
            with redirect_stdout(io.StringIO()):
                command(**values)
        except typer.Exit as end:
            code = end
        finally:
            _results.reset(token)
        if results:
            typer.echo(json.dumps(plain(results[-1]), indent=2))
        if code is not None:
            raise code

    parameters = _parameters(command)
    parameters += [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind)
        for name, kind in (("verbose", options.Verbose), ("as_json", _Json))
    ]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def _parameters(command: Callable[..., object]) -> list[inspect.Parameter]:
    """Return the parameters of a command or of a dataclass of options; nested dataclasses of options are expanded."""
    hints = get_type_hints(command, include_extras=True)
    found: list[inspect.Parameter] = []
    for name, each in inspect.signature(command).parameters.items():
        if is_dataclass(hints[name]):
            found += _parameters(hints[name])
        else:
            found.append(each.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[name]))
    return found


def plain(value: object) -> object:
    """Convert a value to types that JSON has; NaN and infinity, which it lacks, become null.

    Raises:
        TypeError: if the value has a type that cannot be converted.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # arrays and scalars of numpy
        return plain(value.tolist())
    raise TypeError(f"{type(value).__name__} is no value of JSON")

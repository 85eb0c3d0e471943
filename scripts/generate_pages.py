"""Writes what is generated of docs/reference: the kinds of events, the configuration and the commands.

    .venv/bin/python scripts/generate_pages.py

In each page the lines after the marker are replaced; what is before it is written by hand.
"""

import ast
import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from itertools import groupby
from pathlib import Path
from typing import Any, get_args, get_type_hints

import typer

from graphvio.cli import app
from graphvio.config import Config, stages

ROOT = Path(__file__).parent.parent
REFERENCE = ROOT / "docs" / "reference"
MARKER = "<!-- The lines below are written by scripts/generate_pages.py. -->\n"
_VALUES = {Path: "PATH", str: "TEXT", int: "INTEGER", float: "NUMBER"}
_SECTION = r"^    # -+ (?P<section>[^\n]+)$"
_KIND = r'^    [A-Z_]+ = "(?P<kind>\w+)"\n    """(?P<text>.+?)"""$'
_ENTRY = re.compile(f"{_SECTION}|{_KIND}", re.MULTILINE | re.DOTALL)


def page(name: str) -> str:
    """Return a page as it should be: what is written by hand, and what is generated now."""
    by_hand, marker, _ = (REFERENCE / f"{name}.md").read_text().partition(MARKER)
    return f"{by_hand}{marker}" + "\n".join(GENERATED[name]()) + "\n"


def events() -> Iterator[str]:
    """List the kinds of events with their sentences, from the source of `EventKind`."""
    source = (ROOT / "graphvio" / "measurements" / "events.py").read_text()
    for entry in _ENTRY.finditer(source):
        if entry["section"]:
            title = entry["section"][0].upper() + entry["section"][1:]
            yield from ("", f"## {title}", "", "| kind | what happened, and what is done |", "|---|---|")
        else:
            yield f"| `{entry['kind']}` | {_cell(entry['text'])} |"


def configuration() -> Iterator[str]:
    """List the values of each stage with their docstrings."""
    tree = ast.parse(Path(stages.__file__).read_text())
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    config = Config()
    for stage in fields(config):
        values = getattr(config, stage.name)
        described = classes[type(values).__name__]
        yield from ("", f"## `{stage.name}`", "", _cell(ast.get_docstring(described) or ""), "")
        yield from ("| key | default | meaning |", "|---|---|---|")
        docs = _docs_of_fields(described)
        hints = get_type_hints(type(values))
        for value in fields(values):
            choices = [choice for choice in get_args(hints[value.name]) if isinstance(choice, str)]
            meaning = _cell(docs[value.name])
            if not all(f"`{choice}`" in meaning for choice in choices):
                meaning = f"One of {', '.join(f'`{choice}`' for choice in choices)}. {meaning}"
            default = getattr(values, value.name)
            yield f"| `{value.name}` | {'null' if default is None else default} | {meaning} |"


def _docs_of_fields(described: ast.ClassDef) -> dict[str, str]:
    """Return name -> the docstring below each field."""
    found = {}
    for node, following in zip(described.body, described.body[1:], strict=False):
        if isinstance(node, ast.AnnAssign) and isinstance(following, ast.Expr):
            found[ast.unparse(node.target)] = str(ast.literal_eval(following.value))
    return found


def commands() -> Iterator[str]:
    """List the commands with their arguments and options, as ``--help`` has them."""
    yield from _command(typer.main.get_command(app), "graphvio")


def _command(command: Any, name: str) -> Iterator[str]:
    if name != "graphvio":
        yield from ("", f"## {name.removeprefix('graphvio ')}", "", *_paragraphs(command.help))
    children = getattr(command, "commands", None)
    if children is not None:
        for child, each in children.items():
            yield from _command(each, f"{name} {child}")
        return
    shown = [param for param in command.params if not param.hidden]
    usage = [_names(param) for param in shown if param.param_type_name == "argument"]
    yield from ("```text", " ".join([name, *usage, "[OPTIONS]"]), "```", "")
    yield from ("| argument or option | default | meaning |", "|---|---|---|")
    for param in shown:
        yield f"| `{_names(param)}` | {_default(param.default)} | {_bracketed(param.help)} |"


def _names(param: Any) -> str:
    """Return an argument's or option's names, with what its value is."""
    annotation = param.type_descriptor.annotation
    value = param.metavar or _VALUES.get(annotation, "") or "|".join(map(str, get_args(annotation))) or "VALUE"
    if param.param_type_name == "argument":
        name = f"{param.metavar or param.name.upper()}{'...' if param.nargs < 0 else ''}"
        return name if param.required else f"[{name}]"
    options = [*param.opts, *param.secondary_opts]
    return ", ".join(options if param.is_flag else [f"{option} {value}" for option in options])


def _bracketed(text: str | None) -> str:
    """Return a help text as a cell; its brackets are no links."""
    return _cell(text or "").replace("[", "\\[")


def _default(default: object) -> str:
    if default is None or default is False or default in ((), []) or callable(default):
        return ""
    return f"`{default}`"


def _paragraphs(text: str | None) -> Iterator[str]:
    """Yield a help text as Markdown: its paragraphs, and its examples as a block of code."""
    parts = re.split(r"\n\s*\n", (text or "").strip("\n"))
    for is_code, group in groupby(parts, key=lambda part: part.startswith("    ")):
        if is_code:
            yield from ("```text", *(line.strip() for part in group for line in part.splitlines()), "```", "")
        else:
            for part in group:
                yield from (" ".join(part.split()), "")


def _cell(text: str) -> str:
    """Return a text as one cell of a table."""
    return " ".join(text.split()).replace("``", "`").replace("|", "\\|")


GENERATED: dict[str, Callable[[], Iterator[str]]] = {
    "events": events,
    "configuration": configuration,
    "commands": commands,
}


if __name__ == "__main__":
    for each in GENERATED:
        (REFERENCE / f"{each}.md").write_text(page(each))

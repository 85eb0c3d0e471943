"""A page for people: one file of HTML that holds its style and its pictures."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 860px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.2em; margin-top: 2em; border-top: 1px solid #ddd; padding-top: 1em; }
table { border-collapse: collapse; margin: 0.8em 0; } th { text-align: left; font-weight: 600; }
td, th { padding: 0.25em 0.9em 0.25em 0; border-bottom: 1px solid #eee; vertical-align: top; }
td { font-variant-numeric: tabular-nums; } img { max-width: 100%; } figure { margin: 1em 0; }
figcaption { color: #555; font-size: 0.92em; } .good { color: #1a7f37; } .doubt { color: #b35900; }
pre { background: #f6f6f6; padding: 0.7em; overflow-x: auto; font-size: 0.85em; }
table.small { font-size: 0.85em; line-height: 1.35; } table.small td:not(:last-child) { white-space: nowrap; }
"""


def html_page(title: str, parts: Iterable[str]) -> str:
    """The whole file.

    Args:
        title: in the browser's head, as text.
        parts: the body, as HTML.
    """
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def picture(name: str, png: bytes, caption: str) -> str:
    """A PNG inside the page; name and caption are HTML."""
    data = b64encode(png).decode("ascii")
    return f'<figure><img alt="{name}" src="data:image/png;base64,{data}"><figcaption>{caption}</figcaption></figure>'


def bullets(items: Iterable[str]) -> str:
    """A list of texts."""
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


def table(rows: Iterable[Sequence[str]], head: Sequence[str] = (), *, small: bool = False) -> str:
    """Rows of texts under a head of texts; ``small`` is for long ones."""
    lines = ["".join(f"<th>{escape(cell)}</th>" for cell in head)] if head else []
    lines += ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    begin = '<table class="small">' if small else "<table>"
    return begin + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"

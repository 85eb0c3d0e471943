"""HTML pages from templates."""

import pytest
from jinja2 import UndefinedError

from graphvio.fleet.table import COLUMNS
from graphvio.reporting.html import render


def test_render_text_with_markup_is_escaped() -> None:
    row = dict.fromkeys(COLUMNS, "") | {"name": "<b>&'", "status": "failed"}
    page = render("fleet/summary.html", rows=[row], columns=COLUMNS)
    assert "<b>" not in page
    assert "&lt;b&gt;&amp;&#39;" in page


def test_render_missing_value_raises() -> None:
    with pytest.raises(UndefinedError, match="columns"):
        render("fleet/summary.html", rows=[])

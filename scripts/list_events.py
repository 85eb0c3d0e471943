"""Writes docs/reference/events.md, the kinds of events with their sentences, from their enumeration."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
_SECTION = r"^    # -+ (?P<section>[^\n]+)$"
_KIND = r'^    [A-Z_]+ = "(?P<kind>\w+)"\n    """(?P<text>.+?)"""$'
_ENTRY = re.compile(f"{_SECTION}|{_KIND}", re.MULTILINE | re.DOTALL)


def page() -> str:
    """Return the page as Markdown."""
    lines = [
        "# Kinds of events",
        "",
        "Written by `scripts/list_events.py` from `graphvio.measurements.events.EventKind`. Events are in a run's",
        "`events.jsonl`, in what `Odometry.take_events` returns, and on `/rosout` of sessions and ROS 2.",
    ]
    source = (ROOT / "graphvio" / "measurements" / "events.py").read_text()
    for entry in _ENTRY.finditer(source):
        if entry["section"]:
            title = entry["section"][0].upper() + entry["section"][1:]
            lines += ["", f"## {title}", "", "| kind | what happened, and what is done |", "|---|---|"]
        else:
            lines.append(f"| `{entry['kind']}` | {' '.join(entry['text'].split())} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    (ROOT / "docs" / "reference" / "events.md").write_text(page())

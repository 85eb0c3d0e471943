"""Looks for retired words in the code, the documentation and the tests; the list is in pyproject.toml."""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
FOLDERS = ("graphvio", "tests", "scripts", "docs", "configs", "examples")
SUFFIXES = (".py", ".md", ".proto", ".yaml", ".html", ".css", ".js", "")
OWN_WORDS = (
    "<span",
    "</span",
    "axvspan",
    "axhspan",
    "bbox_to_anchor",
    "offered_qos_profiles",
    '"starts"',
)  # of others, or of files


def main() -> int:
    words = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["vocabulary"]["retired"]
    # A word may be a part of an identifier: `_` and a change of case end it, letters do not.
    retired = re.compile(rf"(?<![A-Za-z])({'|'.join(words)})(?![a-z])", re.IGNORECASE)
    files = [ROOT / "README.md"]
    for folder in FOLDERS:
        files += [p for p in sorted((ROOT / folder).rglob("*")) if p.is_file() and p.suffix in SUFFIXES]
    found = 0
    for path in files:
        if "_pb2" in path.name or "__pycache__" in path.parts:
            continue
        for number, line in enumerate(path.read_text().splitlines(), 1):
            for own in OWN_WORDS:
                line = line.replace(own, "")
            for match in retired.finditer(line):
                found += 1
                print(f"{path.relative_to(ROOT)}:{number}: {match.group()!r} is not one of the glossary's terms")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

"""The command line of ``scripts/fingerprint``."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter

from fingerprints.cases import SCENES, Line, cases, lines_of, render

_DESCRIPTION = """Prints a digest of every numerical result: where two outputs are equal, a change of the code between
them has changed no number. Names of kinds of events count in the lines that end in /events alone."""


def main() -> int:
    """Run the selected cases, print their digests, and report the lines that differ from a file."""
    parser = argparse.ArgumentParser(prog="scripts/fingerprint", description=_DESCRIPTION)
    parser.add_argument("--write", type=Path, metavar="FILE", help="also write the lines to this file")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="exit code 1 if a digest is not as in this file")
    parser.add_argument("--parts", metavar="TEXT,...", help="only cases that are named so: run,calibrate,room/paper")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes at a time (default: %(default)s)")
    parser.add_argument("--recordings", type=Path, metavar="DIR", help="keep simulated recordings here, or take them")
    args = parser.parse_args()
    begin, parts = perf_counter(), (args.parts or "").split(",")
    chosen = [name for name in cases() if any(part in name for part in parts)]
    if not chosen:
        parser.error(f"--parts {args.parts}: is in none of {', '.join(cases())}")
    found: list[Line] = []
    with tempfile.TemporaryDirectory(prefix="recordings-") as folder:
        for line in _lines(chosen, (args.recordings or Path(folder)).resolve(), args.jobs):
            found.append(line)
            print(_text(*line), flush=True)
    print(f"{perf_counter() - begin:.0f} s", file=sys.stderr)
    if args.write:
        args.write.write_text("".join(f"{_text(*line)}\n" for line in found))
    is_equal = args.compare is None or _is_equal(found, args.compare, is_whole=len(chosen) == len(cases()))
    return int(not is_equal or any(digest == "failed" for _, digest, _ in found))


def _text(name: str, digest: str, figure: str) -> str:
    return f"{name:<46} {digest:<16} {figure}".rstrip()


def _lines(chosen: list[str], recordings: Path, jobs: int) -> Iterator[Line]:
    """Yield the lines in the order of the cases. The last case is run first, since it takes longest."""
    recordings.mkdir(parents=True, exist_ok=True)
    scenes = [scene for scene in SCENES if any(name.split("/")[1] == scene for name in chosen)]
    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(lambda scene: render(scene, recordings), scenes)
        begun = {name: pool.submit(lines_of, name, recordings) for name in (*chosen[-1:], *chosen[:-1])}
        for name in chosen:
            yield from begun[name].result()


def _is_equal(found: list[Line], path: Path, is_whole: bool) -> bool:
    """Return whether the digests equal those of a file, and print the lines that differ.

    Lines that only the file has count as different if all cases were run (``is_whole``).
    """
    before = {fields[0]: fields[1] for line in path.read_text().splitlines() if (fields := line.split())}
    now = {name: digest for name, digest, _ in found}
    names = [*now, *(name for name in before if is_whole and name not in now)]
    differing = [name for name in names if before.get(name) != now.get(name)]
    for name in differing:
        print(f"differs: {name}: {before.get(name, 'absent')} before, {now.get(name, 'absent')} now", file=sys.stderr)
    print(f"{len(names) - len(differing)} of {len(names)} lines are equal", file=sys.stderr)
    return not differing


if __name__ == "__main__":
    sys.exit(main())

"""Plots graphvio's packages by the layers of the import contract, with the imports between them.

    .venv/bin/python scripts/plot_layers.py [docs/images/layers.png]

The layers come from the contract in pyproject.toml, the imports from grimp. Left out, so that the others can be
followed, are arrows that a longer path of arrows implies, and those to the lowest layer, which nearly all packages
import.
"""

import random
import sys
import tomllib
from collections import Counter
from pathlib import Path

import grimp
import matplotlib as mpl
import numpy as np
from PIL import Image

mpl.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "graphvio"
COLUMNS = 6
HALF_WIDTH, HALF_HEIGHT = 0.44, 0.3  # of a box, in columns and layers
ROUNDS = 40_000
INK, CORE, OTHER, BAND = "#2f4b6e", "#cfe3f7", "white", "#f3f3f0"

Imports = dict[tuple[str, str], int]
Places = dict[str, tuple[int, int]]


def contract(name: str) -> dict[str, list[str]]:
    """The import contract whose name has these words."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    return next(each for each in contracts if name in each["name"])


def layers() -> list[list[str]]:
    """The contract's layers, lowest first, each with its packages and modules."""
    return [[name.strip() for name in layer.split("|")] for layer in reversed(contract("layers")["layers"])]


def packages() -> set[str]:
    """Names of the packages and modules directly below graphvio."""
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    return folders | {path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__"}


def lines_of_code(name: str) -> int:
    """Lines of a package's or module's Python files; generated files do not count."""
    files = [PACKAGE / f"{name}.py"] if (PACKAGE / f"{name}.py").exists() else (PACKAGE / name).rglob("*.py")
    return sum(len(path.read_text().splitlines()) for path in files if "_pb2" not in path.name)


def imports() -> Imports:
    """Importing and imported package -> number of module-to-module imports."""
    graph = grimp.build_graph("graphvio", cache_dir=None)
    counts: Counter[tuple[str, str]] = Counter()
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            names = [each.split(".")[1] for each in (module, imported) if "." in each]
            if len(names) == 2 and names[0] != names[1]:
                counts[names[0], names[1]] += 1
    return dict(counts)


def reduced(found: Imports) -> Imports:
    """The transitive reduction: imports that no longer path implies."""
    following: dict[str, set[str]] = {}
    for importing, imported in found:
        following.setdefault(importing, set()).add(imported)

    def reachable(name: str) -> set[str]:
        direct = following.get(name, set())
        return direct.union(*(reachable(each) for each in direct))

    return {
        (importing, imported): count
        for (importing, imported), count in found.items()
        if not any(imported in reachable(other) for other in following[importing])
    }


def arranged(rows: list[list[str]], arrows: Imports) -> Places:
    """Column and row of each package: a random search for arrows that are short and cross no box."""
    rng = random.Random(0)
    places = {name: ((COLUMNS - len(row)) // 2 + n, y) for y, row in enumerate(rows) for n, name in enumerate(row)}
    cost = _cost(places, arrows)
    for step in range(ROUNDS):
        row = rng.choice(rows)
        columns = rng.sample(range(COLUMNS), len(row))
        candidate = places | {name: (column, places[name][1]) for name, column in zip(row, columns, strict=True)}
        new_cost = _cost(candidate, arrows)
        if new_cost <= cost + 3.0 * rng.random() ** 3 * (1.0 - step / ROUNDS):
            places, cost = candidate, new_cost
    return places


def _cost(places: Places, arrows: Imports) -> float:
    by_row: dict[int, list[int]] = {}
    for x, y in places.values():
        by_row.setdefault(y, []).append(x)
    cost = 0.0
    for importing, imported in arrows:
        (x0, y0), (x1, y1) = places[importing], places[imported]
        cost += 0.3 * abs(x0 - x1)
        ends = ((x0, y0), (x1, y1))
        slope = (x1 - x0) / (y0 - y1)
        reach = HALF_WIDTH + abs(slope) * HALF_HEIGHT
        for y in range(y1, y0 + 1):
            crossing = x0 + slope * (y0 - y)
            cost += sum(4.0 for x in by_row[y] if abs(crossing - x) < reach and (x, y) not in ends)
    return cost


def plot(path: Path) -> None:
    """Write the picture."""
    rows = layers()
    core = {name.removeprefix("graphvio.") for name in contract("The core")["source_modules"]}
    arrows = {(low, high): count for (low, high), count in reduced(imports()).items() if high not in rows[0]}
    places = arranged(rows, arrows)
    figure, axes = plt.subplots(figsize=(12, 0.6 * len(rows)))
    figure.subplots_adjust(0, 0, 1, 1)
    for y in range(0, len(rows), 2):
        axes.axhspan(y - 0.5, y + 0.5, color=BAND, linewidth=0)
    for (importing, imported), count in arrows.items():
        start, end = np.array(places[importing], dtype=float), np.array(places[imported], dtype=float)
        x, y = np.abs(end - start)
        end -= (end - start) * min(HALF_HEIGHT / y, HALF_WIDTH / x if x else 1.0)  # at the box's edge
        style = {"arrowstyle": "-|>", "color": INK, "linewidth": 0.5 + 0.4 * count**0.5, "mutation_scale": 12}
        axes.annotate("", end, start, arrowprops=style | {"shrinkA": 0, "shrinkB": 0, "alpha": 0.75})
    for name, (x, y) in places.items():
        corner, colour = (x - HALF_WIDTH, y - HALF_HEIGHT), CORE if name in core else OTHER
        axes.add_patch(plt.Rectangle(corner, 2 * HALF_WIDTH, 2 * HALF_HEIGHT, fc=colour, ec=INK, lw=1.2, zorder=3))
        axes.text(
            x, y + 0.12, name, ha="center", va="center", fontsize=min(12.5, 190 / len(name)), weight="bold", zorder=4
        )
        size = f"{lines_of_code(name)} lines"
        axes.text(x, y - 0.15, size, ha="center", va="center", fontsize=10, color="#444444", zorder=4)
    axes.set(xlim=(-0.55, COLUMNS - 0.45), ylim=(-0.5, len(rows) - 0.5))
    axes.axis("off")
    figure.canvas.draw()
    Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB").quantize(32).save(path, optimize=True)


if __name__ == "__main__":
    plot(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs/images/layers.png")

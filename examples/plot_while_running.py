"""Plot the path of a live rig while it is estimated, as a PNG that is replaced twice a second.

    python plot_while_running.py path.png                     # a simulated rig; rendering it takes a minute, once
    python plot_while_running.py path.png realsense           # or any source of `graphvio live --list`

The odometry runs in threads of its own; this program only takes the newest estimates. A reader that does not keep up
gets fewer estimates, and never delays the odometry.
"""

from __future__ import annotations

import sys
from pathlib import Path

from matplotlib.figure import Figure

from graphvio import Config
from graphvio.live.running import LiveOdometry
from graphvio.live.sources import open_live_source


def plot(path: list[tuple[float, float]], file: Path) -> None:
    """Plot the path from above; whoever shows the file never sees half of it."""
    figure = Figure(figsize=(6, 6))
    axes = figure.add_subplot(xlabel="x, m", ylabel="y, m", aspect="equal", title=f"{len(path)} poses")
    axes.plot(*zip(*path, strict=True), color="tab:blue")
    axes.plot(*path[-1], "o", color="tab:red")
    unfinished = file.with_suffix(".part.png")
    figure.savefig(unfinished)
    unfinished.replace(file)


def main() -> None:
    """Plot until the source has ended."""
    file = Path(sys.argv[1])
    source = open_live_source(sys.argv[2] if len(sys.argv) > 2 else "simulator:room?duration_s=10")
    try:
        running = LiveOdometry(source, source.open(), Config())
        estimates = running.estimates.subscribe(1000)
        running.start()
        path: list[tuple[float, float]] = []
        plots, is_over = 0, False
        while not is_over:
            is_over = running.wait(0.5)
            while (estimate := estimates.get(0.0)) is not None:
                if estimate.nav_T_body is not None:
                    path.append((estimate.nav_T_body[0, 3], estimate.nav_T_body[1, 3]))
            if path:
                plot(path, file)
                plots += 1
        running.stop()
    finally:
        source.close()
    print(f"{plots} plots, the last with {len(path)} poses: {file}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main()

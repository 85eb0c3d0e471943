"""The closing table of scripts/demo: figures of the run, and its files."""

import json
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table


def main() -> None:
    out, seconds = Path(sys.argv[1]), sys.argv[2]
    summary = json.loads((out / "results" / "summary.json").read_text())
    evaluation = json.loads((out / "evaluation.json").read_text())
    table = Table("figure", "value", title=f"a walk of {evaluation['path_length_m']:.1f} m with two stereo pairs")
    table.add_row("ATE rmse", f"{100 * evaluation['ate_position_m']['rmse']:.1f} cm")
    table.add_row("drift at the end", f"{evaluation['drift_percent']:.2f} % of the path")
    table.add_row("completion", f"{100 * summary['completion']:.0f} %")
    table.add_row("real-time factor", f"{summary['realtime_factor']:.2f}")
    console = Console()
    console.print(table)
    console.print(f"trajectory  {out / 'results' / 'trajectory.txt'}", highlight=False)
    console.print(f"pictures    {out / 'results' / 'trajectory.png'}, {out / 'evaluation.png'}", highlight=False)
    console.print(f"recording   {out / 'corridor'} (EuRoC layout)", highlight=False)
    console.print(f"made in {seconds} s", highlight=False)


if __name__ == "__main__":
    main()

"""Program that ``scripts/benchmark startup`` runs: prints as JSON the seconds of each step up to the first estimate.

Usage: ``python -m benchmarks.first_estimate RECORDING PAIRS IMU``, with PAIRS such as 0 or 0,1 and IMU yes or no. All
imports are within the measured time.
"""

import json
import sys
from pathlib import Path
from time import perf_counter

_BEGIN_S = perf_counter()


def main() -> None:
    """Open the recording and process it up to the first estimate, as ``graphvio run`` does."""
    laps, last_s = {}, _BEGIN_S

    def lap(name: str) -> None:
        nonlocal last_s
        now_s = perf_counter()
        laps[name], last_s = now_s - last_s, now_s

    from graphvio.cli.options import ReadingOptions
    from graphvio.cli.shared import open_recording
    from graphvio.config import Config
    from graphvio.odometry import Odometry
    from graphvio.pipeline import run  # noqa: F401 - the command imports it
    from graphvio.results import ResultWriter  # noqa: F401
    from graphvio.runtime import set_up_threads
    from graphvio.warmup import warm_up

    lap("import")
    path, pairs, imu = sys.argv[1:]
    config = Config()
    recording = open_recording(Path(path), ReadingOptions(pairs=pairs, no_imu=imu == "no"), config)
    lap("open")
    set_up_threads()
    warm_up(recording.rig, config, wait_for_calibration=False)
    lap("kernels")
    odometry = Odometry(recording.rig, config)
    for measurement in recording:
        estimate = odometry.process(measurement)
        if estimate is not None and estimate.nav_T_body is not None:
            break
    lap("first pose")
    odometry.finish()
    print(json.dumps(laps))


if __name__ == "__main__":
    main()

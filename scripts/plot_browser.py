"""Takes the picture of the view in a browser: a walk through the simulated room, in a headless Chromium.

.venv/bin/python scripts/plot_browser.py [docs/images/browser.png]
"""

import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from browser import CHROMIUM, Browser, free_options  # noqa: E402

from graphvio import Config, Odometry, open_source  # noqa: E402
from graphvio.pipeline import RunListener, run  # noqa: E402
from graphvio.results import ResultWriter  # noqa: E402
from graphvio.runtime import set_up_threads  # noqa: E402
from graphvio.simulation import simulate  # noqa: E402
from graphvio.viewer import Viewer  # noqa: E402

SECONDS = 12.0
RENDERED_S = 60.0  # the processor renders a frame of the page in seconds


def main(picture: Path) -> int:
    if CHROMIUM is None:
        print("no Chromium is installed (Debian: chromium)", file=sys.stderr)
        return 2
    set_up_threads()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        simulate("room", folder / "room", duration_s=SECONDS)
        source, config, web = open_source(folder / "room"), Config(), free_options()
        with Viewer(source.rig, web=web) as viewer, Browser(folder / "profile") as browser:
            browser.open(web.url)
            shown = RunListener(
                on_estimate=viewer.show, on_event=viewer.show_event, on_calibration=viewer.show_calibration
            )
            with ResultWriter(folder / "results", source.rig, config.to_yaml()) as writer:
                run(source, Odometry(source.rig, config), writer, [shown])
            until = time.monotonic() + RENDERED_S
            while time.monotonic() < until:
                image = browser.screenshot()
            picture.write_bytes(image)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs/images/browser.png"))

"""Opens every page of the documentation site in a headless Chromium, at the width of a telephone and of a desktop.

.venv/bin/python scripts/check_site.py [FOLDER]     # FOLDER gets a screenshot of each page

Fails where a page is wider than the window, an image is not shown, or a link within the site leads nowhere.
`scripts/test` builds the site and tries its search.
"""

import functools
import http.server
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from browser import CHROMIUM, Browser  # noqa: E402

SIZES_PX = {"narrow": (400, 800), "wide": (1300, 900)}
LINKS = "[...document.querySelectorAll('a[href]')].map(link => link.href)"
IDENTIFIERS = "[...document.querySelectorAll('[id]')].map(element => element.id)"
LAZY = "document.querySelectorAll('img').forEach(image => { image.loading = 'eager'; })"
BROKEN = "[...document.images].filter(i => !i.complete || i.naturalWidth === 0).map(i => i.src)"
WIDER_PX = "document.scrollingElement.scrollWidth - document.scrollingElement.clientWidth"


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


def main() -> int:
    if CHROMIUM is None:
        print("no Chromium is installed (Debian: chromium)", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as temporary:
        site = Path(temporary) / "site"
        command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(site)]
        subprocess.run(command, cwd=ROOT, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
        handler = functools.partial(Quiet, directory=str(site))
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            address = f"http://127.0.0.1:{server.server_port}/"
            pages = [str(file.parent.relative_to(site)) for file in sorted(site.rglob("index.html"))]
            faults = looked_at(address, pages, Path(temporary), Path(sys.argv[1]) if len(sys.argv) > 1 else None)
            server.shutdown()
    for fault in faults:
        print(fault)
    print(f"{len(pages)} pages at {len(SIZES_PX)} widths, {len(faults)} faults")
    return 1 if faults else 0


def looked_at(address: str, pages: list[str], temporary: Path, screenshots: Path | None) -> list[str]:
    """Open all pages at all widths; returns what is wrong."""
    faults = []
    links: dict[str, set[str]] = {}
    identifiers: dict[str, set[str]] = {}
    for width, size_px in SIZES_PX.items():
        with Browser(temporary / width, size_px) as browser:
            for page in pages:
                browser.open(urljoin(address, "" if page == "." else f"{page}/"))
                browser.value(LAZY)
                wider_px, broken = browser.value(WIDER_PX), browser.value(BROKEN)
                faults += [f"{page}, {width}: {wider_px} px wider than the window"] if wider_px > 0 else []
                faults += [f"{page}, {width}: {image} is not shown" for image in broken]
                links[page], identifiers[page] = set(browser.value(LINKS)), set(browser.value(IDENTIFIERS))
                if screenshots is not None:
                    screenshots.mkdir(parents=True, exist_ok=True)
                    name = page.replace("/", "-").replace(".", "index")
                    (screenshots / f"{name}-{width}.png").write_bytes(browser.screenshot())
    for page, targets in links.items():
        for target in sorted(targets):
            parts = urlsplit(target)
            if not target.startswith(address):
                continue
            to = parts.path.strip("/") or "."
            if to not in identifiers:
                faults.append(f"{page} links to {parts.path}, which is no page")
            elif parts.fragment and unquote(parts.fragment) not in identifiers[to]:
                faults.append(f"{page} links to {parts.path}#{parts.fragment}, which is no heading")
    return faults


if __name__ == "__main__":
    sys.exit(main())

"""The documentation site as it is built: nothing is loaded from elsewhere, and its search finds pages."""

import functools
import http.server
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def address(site: Path) -> Iterator[str]:
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        text = page.read_text()
        sources = re.findall(r"<(?:script|img|iframe)[^>]* src=\"?([^\s\">]+)", text)
        sources += re.findall(r"<link[^>]* href=\"?([^\s\">]+)", text)
        assert sources
        assert [url for url in sources if re.match(r"(https?:)?//", url)] == [], page.name
        assert 'class="mermaid"' not in text, "mermaid would be loaded from elsewhere"


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_search_finds_pages(address: str, tmp_path: Path) -> None:
    with Browser(tmp_path) as browser:
        browser.open(f"{address}?q=keyframe")
        until = time.monotonic() + 60.0
        found: list[str] = []
        while not found and time.monotonic() < until:
            time.sleep(0.2)
            found = browser.value("[...document.querySelectorAll('.md-search-result__link')].map(link => link.href)")
    assert any("explanation/how-it-works/" in link for link in found), found

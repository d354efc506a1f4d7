"""The documentation as a site: built strictly, and read page by page in a browser that is told of every request."""

import functools
import os
import re
import shutil
import subprocess
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CHROMIUM = shutil.which("chromium")
PHONE = {"width": 390, "height": 844}
playwright = pytest.importorskip("playwright.sync_api")
pytest.importorskip("mkdocstrings")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; Debian has it as a package")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """Say nothing."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The address of the site."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "-d", str(folder)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    )
    assert done.returncode == 0, done.stderr
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    server.server_close()


def test_every_page_loads_without_the_world_and_fits_a_phone(site):
    names = re.findall(r"([\w-]+)\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    faults = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport=PHONE)
        page.on("request", lambda asked: asked.url.startswith((site, "data:")) or faults.append(asked.url))
        page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("response", lambda got: faults.append(f"{got.status} {got.url}") if got.status >= 400 else None)
        for name in names:
            page.goto(f"{site}{name}.html", wait_until="load")
            if page.evaluate("document.documentElement.scrollWidth") > PHONE["width"]:
                faults.append(f"{name}: wider than a phone")
        browser.close()
    assert len(names) > 25
    assert faults == []

"""The pictures of docs/console.md: a recording in the console, as a Chromium without a screen shows it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

_SETTINGS = ("path.start_z_m=12", "path.end_z_m=-1", "path.frame_interval_s=0.3", "faults.missing=1")
_DESKTOP, _PHONE = (1280, 1180), (390, 1180)
_PATIENCE_MS = 180_000
_CAMERA = """\
image_width: 1224
image_height: 1024
camera_name: half of imx264-60deg
camera_matrix: {rows: 3, cols: 3, data: [1060, 0, 611.5, 0, 1060, 511.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""


def simulate(folder: Path) -> Path:
    """A sequence of some 40 frames in green water, with a dark lamp."""
    (folder / "camera.yaml").write_text(_CAMERA)
    command = [sys.executable, "-m", "lumidock", "sim", "approach", "--seed", "3", "--camera", folder / "camera.yaml"]
    command += [word for setting in _SETTINGS for word in ("--set", setting)]
    subprocess.run([*map(str, command), "--out", str(folder / "sequence")], check=True, capture_output=True)
    return folder / "sequence"


@contextmanager
def started(*words: object) -> Iterator[tuple[str, int]]:
    """A command of lumidock that serves the console: the address that it prints, and the number of its process."""
    command = [sys.executable, "-m", "lumidock", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().split()[-1], process.pid
    finally:
        process.terminate()
        process.wait(30)


@contextmanager
def address_of(*words: object) -> Iterator[str]:
    """The address of such a command alone."""
    with started(*words) as (address, _):
        yield address


@contextmanager
def chromium(asking: str) -> Iterator[Browser]:
    """A browser without a screen. Raises: SystemExit where there is none."""
    from playwright.sync_api import sync_playwright  # here, so that the other benches run without it

    path = shutil.which("chromium")
    if path is None:
        raise SystemExit(f"{asking}: needs chromium; Debian has it as a package")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


def opened(browser: Browser, address: str, size: tuple[int, int], scheme: str) -> Page:
    """The console in a window of `size` (width, height) px, "light" or "dark"."""
    viewport = {"width": size[0], "height": size[1]}
    page = browser.new_context(viewport=viewport, color_scheme=scheme).new_page()  # type: ignore[arg-type]
    page.set_default_timeout(_PATIENCE_MS)
    page.goto(address)
    return page


def shoot(page: Page, name: str) -> str:
    """Write a picture of what is on the screen; its line for a page of the documentation."""
    page.wait_for_timeout(800)
    path = Path("docs") / f"console-{name}.jpg"
    page.screenshot(path=path, type="jpeg", quality=82)
    return f"![The console: {name}]({path.name})"


def replay(browser: Browser, sequence: Path) -> list[str]:
    """A recording at its side: one frame, two variants beside each other, on a phone, and the settings."""
    with address_of("console", sequence, "--port", 0) as address:
        page = opened(browser, address, _DESKTOP, "light")
        page.locator(".picture .mark.front").first.wait_for()
        page.get_by_text("reading:").wait_for(state="hidden")
        page.keyboard.press("Shift+ArrowRight")
        page.keyboard.press("Shift+ArrowRight")
        page.get_by_text("21 of").wait_for()
        lines = [shoot(page, "replay")]
        page.get_by_role("tab", name="Settings").click()
        page.get_by_label("Least contrast of a light").fill("500")
        lines.append(shoot(page, "settings"))
        page.get_by_role("button", name="Run the stretch").click()
        page.get_by_text("It is shown as B in Replay").wait_for()
        page.get_by_role("tab", name="Replay").click()
        page.emulate_media(color_scheme="dark")
        page.get_by_role("button", name="Zoom to lights").first.click()
        lines.append(shoot(page, "compare"))
        page.emulate_media(color_scheme="light")
        page.get_by_role("tab", name="Survey").click()
        page.get_by_role("button", name="Show three frames").click()
        page.locator("#panel-survey .mark.front").nth(2).click(force=True)  # its label is asked for
        page.get_by_text("every light carries its own id").first.wait_for()
        lines.append(shoot(page, "survey"))
    return lines


def live(browser: Browser, sequence: Path) -> list[str]:
    """The live view, at a desk and on a phone."""
    with address_of("serve", sequence, "--loop", "--health-port", 0) as address:
        page = opened(browser, address, _DESKTOP, "dark")
        page.locator(".picture .mark.front").first.wait_for()
        page.get_by_role("button", name="Zoom to lights").click()
        page.wait_for_timeout(4000)  # until there is a trail
        phone = opened(browser, address, _PHONE, "light")
        phone.locator(".picture .mark.front").first.wait_for()
        return [shoot(page, "live"), shoot(phone, "phone")]


def main() -> tuple[dict[str, object], list[str]]:
    """Simulate, open and write them. Raises: SystemExit where there is no Chromium."""
    with TemporaryDirectory() as folder, chromium("console-pictures") as browser:
        sequence = simulate(Path(folder))
        lines = [*live(browser, sequence), *replay(browser, sequence)]
    return {"pictures": lines}, lines

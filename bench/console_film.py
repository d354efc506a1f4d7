"""The moving picture of README.md and docs/gallery.md: a recording stepped through in the console."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from bench.console_pictures import address_of, chromium, opened, simulate

_WINDOW = (1180, 1060)
_WIDTH = 880  # px of the film
_STEP_MS = 160  # each frame is shown
_HOLD_MS = 1600  # the last one
_QUALITY = 60  # of WebP: letters stay sharp, and the file stays below 1.5 MB
_MOST_BYTES = 1_500_000
_TARGET = Path("docs/console.webp")


def main() -> tuple[dict[str, object], list[str]]:
    """Simulate, step through, and write. Raises: SystemExit where there is no Chromium, or for a file too large."""
    with TemporaryDirectory() as folder, chromium("console-film") as browser:
        sequence = simulate(Path(folder))
        with address_of("console", sequence, "--port", 0) as address:
            page = opened(browser, address, _WINDOW, "light")
            page.locator(".picture .mark").first.wait_for()
            page.get_by_text("reading:").wait_for(state="hidden")
            page.get_by_role("button", name="Zoom to lights").first.click()
            count = int(page.evaluate("fetch('/api/recording').then((answer) => answer.json())")["count"])
            page.keyboard.press("Home")
            stills = []
            for number in range(1, count + 1):
                page.get_by_text(f"{number} of {count}").first.wait_for()
                page.wait_for_timeout(120)  # until it is drawn
                stills.append(cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR))
                page.keyboard.press("ArrowRight")
    height = round(_WIDTH * _WINDOW[1] / _WINDOW[0])
    film = cv2.Animation()
    film.frames = [cv2.resize(still, (_WIDTH, height), interpolation=cv2.INTER_AREA) for still in stills]
    film.durations = np.array([_STEP_MS] * (len(stills) - 1) + [_HOLD_MS])
    cv2.imwriteanimation(str(_TARGET), film, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    size = _TARGET.stat().st_size
    if size > _MOST_BYTES:
        raise SystemExit(f"{_TARGET}: {size} bytes, wanted at most {_MOST_BYTES}")
    return {"frames": len(stills), "bytes": size}, [f"{_TARGET}: {len(stills)} frames, {size / 1000:.0f} kB"]

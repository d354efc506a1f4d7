"""The rendered scenes that the weights of `p_light` are fitted on and those kept apart: a folder each.

Scenes without matter come from the shipped camera, scenes with matter from a small one of 720 x 576 pixels, as most
real footage has. `python -m bench.lamp_scenes OUT` renders all that are not there yet.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from bench.shipped import CAMERA_FILE, PACKAGE
from lumidock.camera import load_camera

_SMALL = (720, 576)
_MATTER = (("plate", "plate", 1.8), ("cage-matter", "cage-2x2x5", 2.4), ("pool-walls", "cage-2x2x5", 2.4))


class Scene(NamedTuple):
    """A scenario, its station and settings; `held_out` from the fit; `small` for the small camera."""

    scenario: str
    station: str
    seed: int
    held_out: bool
    small: bool
    settings: tuple[str, ...]


def _scenes() -> dict[str, Scene]:
    scenes: dict[str, Scene] = {}
    for name in ("approach", "water-1c", "headlamp", "snow", "pool", "shallow", "fouling"):
        held_out = name in ("snow", "shallow")
        scenes[name] = Scene(name, "cage-2x2x5", 7511, held_out, False, ("path.frame_interval_s=1.5",))
    for exposure_ms in (1.0, 3.0, 8.0):
        for b, day in ((4.0, 1.5), (9.0, 5.0)):
            settings = (
                f"sensor.exposure_ms={exposure_ms}",
                f"water.b_factor={b}",
                f"daylight.surface_w_m2={day}",
                "path.frame_interval_s=1.2",
            )
            scenes[f"funnel-{exposure_ms:g}-{b:g}"] = Scene(
                "funnel", "funnel-ring", 60 + int(exposure_ms), exposure_ms == 3.0 and b == 9.0, True, settings
            )
    for name, station, step in _MATTER:
        for exposure_ms in (1.0, 4.0):
            settings = (f"sensor.exposure_ms={exposure_ms}", f"path.frame_interval_s={step}")
            held_out = name == "plate" and exposure_ms == 4.0
            scenes[f"{name}-{exposure_ms:g}"] = Scene(name, station, 80 + int(exposure_ms), held_out, True, settings)
    return scenes


SCENES = _scenes()


def small_camera(path: Path) -> Path:
    """The shipped camera's field of view in a small picture."""
    camera = load_camera(CAMERA_FILE)
    scale = _SMALL[0] / camera.width
    text = CAMERA_FILE.read_text(encoding="utf-8")
    focal, (cx, cy) = camera.focal_px[0] * scale, ((side - 1) / 2 for side in _SMALL)
    text = text.replace(f"image_width: {camera.width}", f"image_width: {_SMALL[0]}")
    text = text.replace(f"image_height: {camera.height}", f"image_height: {_SMALL[1]}")
    text = text.replace("2087.0", f"{focal:.3f}").replace("1223.5", f"{cx}").replace("1023.5", f"{cy}")
    path.write_text(text, encoding="utf-8")
    return path


def render(name: str, out: Path) -> Path:
    """The folder of a scene; rendered where it is not there yet."""
    scene, folder = SCENES[name], out / name
    if folder.exists():
        return folder
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "lumidock", "sim", scene.scenario, "--seed", str(scene.seed)]
    command += ["--station", str(PACKAGE / "stations" / f"{scene.station}.yaml"), "--out", str(folder)]
    if scene.small:
        command += ["--camera", str(small_camera(out / "small.yaml"))]
    for setting in scene.settings:
        command += ["--set", setting]
    subprocess.run(command, check=True, capture_output=True)
    return folder


if __name__ == "__main__":
    for scene_name in SCENES:
        print(scene_name)
        render(scene_name, Path(sys.argv[1]))

"""The contact sheet docs/contact-sheet.jpg: rendered frames of the shipped dock by range and water."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from bench.shipped import shipped_camera, shipped_station
from lumidock.datatypes import Image
from lumidock.sim.scenario import R_DOCK_CAM_HEAD_ON, load_scenario
from lumidock.sim.schedule import schedule_of

SHEET = Path("docs/contact-sheet.jpg")
ROWS = {
    "Jerlov IB": "water-ib",
    "Jerlov III": "approach",
    "Jerlov 3C, 6 ms": "water-3c",
    "clear pool": "pool",
    "murky pool": "pool-murky",
    "own headlamp, snow": "headlamp",
}
RANGES_M = (18.0, 9.0, 3.0, -2.0)
_TILE, _GAP = (460, 384), 4
_MARGIN, _DOCK_M = 1.7, 2.0  # of a tile over the size of the dock


def picture(scenario: str, z_m: float) -> Image:
    """A frame (2048, 2448, 3) taken on the axis of the dock at z = `z_m`."""
    station = shipped_station()
    schedule = schedule_of(load_scenario(scenario), station, shipped_camera(), 0)
    T_dock_cam = np.eye(4)
    T_dock_cam[:3, :3], T_dock_cam[2, 3] = R_DOCK_CAM_HEAD_ON, z_m
    conditions = replace(schedule.conditions(0), t_s=30.0 - z_m, T_dock_cam=T_dock_cam, T_cam_later=np.eye(4))
    renderer = schedule.renderer(0)
    return np.asarray(renderer.picture_of(renderer.expect(conditions), np.random.default_rng(0)), np.uint8)


def tile(image: Image, z_m: float) -> Image:
    """The part of a frame around the dock, scaled to (384, 460, 3)."""
    height, width = image.shape[:2]
    span = min(_MARGIN * _DOCK_M * float(shipped_camera().focal_px[1]) / max(z_m, 0.1), float(height))
    half = np.array([span * _TILE[0] / _TILE[1], span]) / 2.0
    (u0, v0), (u1, v1) = (np.clip(np.array([width, height]) / 2 + sign * half, 0, [width, height]) for sign in (-1, 1))
    part = image[int(v0) : int(v1), int(u0) : int(u1)]
    return np.asarray(cv2.resize(part, _TILE, interpolation=cv2.INTER_AREA if span > _TILE[1] else cv2.INTER_CUBIC))


def _write(image: Image, text: str, uv: tuple[int, int], scale: float, level: int) -> None:
    """Write a line of text in grey into an image, from pixel `uv` on."""
    gray = (level, level, level)
    cv2.putText(image, text, uv, cv2.FONT_HERSHEY_SIMPLEX, scale, color=gray, thickness=1, lineType=cv2.LINE_AA)


def main() -> tuple[dict[str, object], list[str]]:
    """Render and write it."""
    rows = []
    for name, scenario in ROWS.items():
        tiles = [tile(picture(scenario, z), z) for z in RANGES_M]
        for image, z in zip(tiles, RANGES_M, strict=True):
            text = name if z == RANGES_M[0] else ""
            _write(image, text, (10, 24), 0.6, 230)
            _write(image, f"z = {z:g} m", (10, 372), 0.5, 170)
        rows.append(cv2.hconcat([cv2.copyMakeBorder(t, 0, _GAP, 0, _GAP, cv2.BORDER_CONSTANT) for t in tiles]))
    SHEET.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(SHEET), cv2.vconcat(rows), [cv2.IMWRITE_JPEG_QUALITY, 88])
    return {"sheet": str(SHEET)}, [f"![The dock over range and water]({SHEET})"]

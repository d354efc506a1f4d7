"""Drawing a fix onto its picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Fix, Image, Match
from lumidock.pose import project_lights
from lumidock.station import Station

_LAYER_COLORS = ((80, 220, 255), (255, 190, 60), (120, 255, 120))  # BGR: amber, sky, green
_SPURIOUS = (60, 60, 255)
_TEXT = (235, 235, 235)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, slots=True)
class View:
    """The part of a picture that is shown: its top-left pixel, its size, and pixels on the canvas per pixel."""

    u: int
    v: int
    width: int
    height: int
    scale: float

    def at(self, uv: Array) -> tuple[int, int]:
        """Canvas pixel of a pixel `uv` (2,)."""
        x, y = (uv - [self.u, self.v] + 0.5) * self.scale - 0.5
        return round(float(x)), round(float(y))


def whole(image: Image, width: int) -> View:
    """All of a picture, `width` wide."""
    return View(0, 0, image.shape[1], image.shape[0], width / image.shape[1])


def around_lights(image: Image, fix: Fix, width: int) -> View:
    """The part of a picture around a fix's detections, in the picture's own proportions."""
    if fix.match is None or not len(fix.match.detections):
        return whole(image, width)
    uv = fix.match.detections.uv
    full = np.array([image.shape[1], image.shape[0]])
    share = min(1.0, max(float((2.2 * np.ptp(uv, axis=0) / full).max()), 0.15))
    size = (share * full).astype(int)
    u, v = np.clip((uv.min(axis=0) + uv.max(axis=0)) / 2 - size / 2, 0, full - size).astype(int)
    return View(int(u), int(v), int(size[0]), int(size[1]), width / int(size[0]))


def draw(image: Image, fix: Fix, station: Station, camera: Camera, view: View) -> Image:
    """A copy of an 8-bit picture (H, W[, 3]), as `view` has it, with detections, names, foreseen lights and pose."""
    window = image[view.v : view.v + view.height, view.u : view.u + view.width]
    size = (round(view.width * view.scale), round(view.height * view.scale))
    canvas = cv2.resize(window, size, interpolation=cv2.INTER_AREA if view.scale < 1 else cv2.INTER_LINEAR)
    canvas = cv2.cvtColor(canvas, cv2.COLOR_GRAY2BGR) if canvas.ndim == 2 else canvas
    if fix.T_dock_cam is not None:
        _draw_projected(canvas, project_lights(camera, fix.T_dock_cam, station.p_dock), station, view)
    if fix.match is not None:
        _draw_detections(canvas, fix.match, station, view)
    _draw_caption(canvas, fix)
    return np.asarray(canvas, np.uint8)


def _color(station: Station, light: int) -> tuple[int, int, int]:
    return _LAYER_COLORS[int(station.layer[light]) % len(_LAYER_COLORS)] if light >= 0 else _SPURIOUS


def _draw_projected(canvas: np.ndarray, uv: Array, station: Station, view: View) -> None:
    """A small cross where the pose puts each light."""
    for light, at in enumerate(uv):
        if np.isfinite(at).all() and (np.abs(at) < 1e4).all():
            cv2.drawMarker(canvas, view.at(at), _color(station, light), cv2.MARKER_TILTED_CROSS, 8, 1, cv2.LINE_AA)


def _draw_detections(canvas: np.ndarray, match: Match, station: Station, view: View) -> None:
    """A ring around each detection, with its light's name; red without one."""
    detections = match.detections
    for at, radius, light in zip(detections.uv, detections.radius_px, match.light, strict=True):
        u, v = view.at(at)
        ring = max(9, round(1.6 * float(np.nan_to_num(radius)) * view.scale) + 5)
        cv2.circle(canvas, (u, v), ring, _color(station, light), 1, cv2.LINE_AA)
        if light >= 0:
            _put(canvas, station.ids[light], (u + ring + 3, v - 4), _color(station, light), 0.5)


def _draw_caption(canvas: np.ndarray, fix: Fix) -> None:
    seconds = fix.t_ns * 1e-9
    _put(
        canvas,
        f"{seconds:7.2f} s   {fix.stage}   {fix.status}   {fix.n_used} of {fix.n_seen} lights",
        (14, 28),
        _TEXT,
        0.62,
    )
    if fix.T_dock_cam is not None:
        x, y, z = fix.T_dock_cam[:3, 3]
        _put(canvas, f"x {x:+.2f}   y {y:+.2f}   z {z:+.2f} m", (14, 56), _TEXT, 0.62)
    elif fix.guide is not None:
        x, y = np.rad2deg([fix.guide.bearing_x_rad, fix.guide.bearing_y_rad])
        text = f"bearing {x:+.2f}, {y:+.2f} deg   range {fix.guide.range_m:.2f} m   no pose: {fix.reason}"
        _put(canvas, text, (14, 56), _TEXT, 0.62)
    else:
        _put(canvas, f"no fix: {fix.reason}", (14, 56), _SPURIOUS, 0.62)


def _put(canvas: np.ndarray, text: str, at: tuple[int, int], color: tuple[int, int, int], size: float) -> None:
    cv2.putText(canvas, text, at, _FONT, size, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(canvas, text, at, _FONT, size, color, 1, cv2.LINE_AA)

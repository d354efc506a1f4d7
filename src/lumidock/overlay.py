"""Drawing a fix onto its picture."""

from __future__ import annotations

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Fix, Image
from lumidock.pose import project_lights
from lumidock.station import Station

_LAYER_COLORS = ((80, 220, 255), (255, 190, 60), (120, 255, 120))  # BGR: amber, sky, green
_SPURIOUS = (60, 60, 255)
_TEXT = (235, 235, 235)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw(image: Image, fix: Fix, station: Station, camera: Camera, *, width: int = 1224) -> Image:
    """A copy of the picture (H, W[, 3]), `width` wide, with detections, names, reprojected lights and the pose."""
    scale = width / image.shape[1]
    size = (width, round(image.shape[0] * scale))
    canvas = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    canvas = cv2.cvtColor(canvas, cv2.COLOR_GRAY2BGR) if canvas.ndim == 2 else canvas
    if fix.T_dock_cam is not None:
        _draw_projected(canvas, project_lights(camera, fix.T_dock_cam, station.p_dock), station, scale)
    if fix.match is not None:
        _draw_detections(canvas, fix, station, scale)
    _draw_caption(canvas, fix)
    return np.asarray(canvas, np.uint8)


def _pixel(uv: np.ndarray, scale: float) -> tuple[int, int]:
    u, v = (uv + 0.5) * scale - 0.5
    return round(float(u)), round(float(v))


def _draw_projected(canvas: np.ndarray, uv: np.ndarray, station: Station, scale: float) -> None:
    """A small cross where the pose puts each light."""
    limit = np.array(canvas.shape[1::-1]) / scale
    for at, layer in zip(uv, station.layer, strict=True):
        if np.isfinite(at).all() and (np.abs(at) < 2 * limit).all():
            color = _LAYER_COLORS[int(layer) % len(_LAYER_COLORS)]
            cv2.drawMarker(canvas, _pixel(at, scale), color, cv2.MARKER_TILTED_CROSS, 8, 1, cv2.LINE_AA)


def _draw_detections(canvas: np.ndarray, fix: Fix, station: Station, scale: float) -> None:
    """A ring around each detection, with its light's name; red without one."""
    assert fix.match is not None
    spots = fix.match.detections
    for at, radius, light in zip(spots.uv, spots.radius_px, fix.match.light, strict=True):
        u, v = _pixel(at, scale)
        ring = max(9, round(1.6 * float(np.nan_to_num(radius)) * scale) + 5)
        color = _LAYER_COLORS[int(station.layer[light]) % len(_LAYER_COLORS)] if light >= 0 else _SPURIOUS
        cv2.circle(canvas, (u, v), ring, color, 1, cv2.LINE_AA)
        if light >= 0:
            _put(canvas, station.ids[light], (u + ring + 3, v - 4), color, 0.5)


def _draw_caption(canvas: np.ndarray, fix: Fix) -> None:
    seconds = fix.t_ns * 1e-9
    _put(
        canvas,
        f"{seconds:7.2f} s   {fix.stage}   {fix.status}   {fix.n_used} of {fix.n_seen} lights",
        (14, 28),
        _TEXT,
        0.62,
    )
    if fix.T_dock_cam is None:
        _put(canvas, f"no fix: {fix.reason}", (14, 56), _SPURIOUS, 0.62)
    else:
        x, y, z = fix.T_dock_cam[:3, 3]
        _put(canvas, f"x {x:+.2f}   y {y:+.2f}   z {z:+.2f} m", (14, 56), _TEXT, 0.62)


def _put(canvas: np.ndarray, text: str, at: tuple[int, int], color: tuple[int, int, int], size: float) -> None:
    cv2.putText(canvas, text, at, _FONT, size, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(canvas, text, at, _FONT, size, color, 1, cv2.LINE_AA)

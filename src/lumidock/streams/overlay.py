"""Drawing a fix onto its image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Fix, Image, Match
from lumidock.pose import project_lights
from lumidock.station import Station
from lumidock.streams.colors import SPURIOUS_ON_WATER, bgr, of_layer

LEAST_P_LIGHT = 0.1  # less probable detections that were not identified are not drawn: they would hide the others
_BRIGHT, _MOST_GAIN = 220.0, 5.0  # grey level that the brightest lights are brought to, and by how much at most
_TEXT = (235, 235, 235)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHADE = 0.35  # of its brightness is left of the image behind a text


@dataclass(frozen=True, slots=True)
class Crop:
    """The part of an image that is shown: its top-left pixel, its size, and pixels on the canvas per pixel."""

    u: int
    v: int
    width: int
    height: int
    scale: float

    def at(self, uv: Array) -> tuple[int, int]:
        """Canvas pixel of a pixel `uv` (2,)."""
        x, y = (uv - [self.u, self.v] + 0.5) * self.scale - 0.5
        return round(float(x)), round(float(y))

    def cut(self, image: Image) -> Image:
        """The part of an 8-bit image (H, W[, 3]), scaled."""
        window = image[self.v : self.v + self.height, self.u : self.u + self.width]
        size = (round(self.width * self.scale), round(self.height * self.scale))
        way = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(window, size, interpolation=way), np.uint8)


def whole(image: Image, width: int) -> Crop:
    """All of an image, `width` wide."""
    return Crop(0, 0, image.shape[1], image.shape[0], width / image.shape[1])


def around_lights(image: Image, fix: Fix, width: int) -> Crop:
    """The part of an image around the identified lights, in the image's own proportions; all of it without any."""
    if fix.match is None or not (fix.match.light >= 0).any():
        return whole(image, width)
    uv = fix.match.detections.uv[fix.match.light >= 0]
    full = np.array([image.shape[1], image.shape[0]])
    share = min(1.0, max(float((2.2 * np.ptp(uv, axis=0) / full).max()), 0.15))
    size = (share * full).astype(int)
    u, v = np.clip((uv.min(axis=0) + uv.max(axis=0)) / 2 - size / 2, 0, full - size).astype(int)
    return Crop(int(u), int(v), int(size[0]), int(size[1]), width / int(size[0]))


def brightened(image: Image) -> tuple[Image, float]:
    """An 8-bit image in which a person can see the lights, and the factor by which its contrast was raised."""
    brightest = float(np.percentile(image, 99.98))
    water = 0.7 * float(np.median(image))
    gain = min(_MOST_GAIN, _BRIGHT / max(brightest - water, 1.0))
    if brightest > _BRIGHT / 1.1:
        return image, 1.0
    return np.clip((image.astype(np.float32) - water) * gain, 0.0, 255.0).astype(np.uint8), gain


def shown_detections(match: Match) -> np.ndarray:
    """Indices (K,) of the detections worth a ring: those identified as lights, and others that may be lamps."""
    return np.flatnonzero((match.light >= 0) | ~(match.detections.p_light < LEAST_P_LIGHT))


def draw(image: Image, fix: Fix, station: Station, camera: Camera, crop: Crop) -> Image:
    """A copy of the `crop` of an 8-bit image (H, W[, 3]) with detections, light ids, projected lights and the pose."""
    canvas = crop.cut(image)
    canvas = np.asarray(cv2.cvtColor(canvas, cv2.COLOR_GRAY2BGR), np.uint8) if canvas.ndim == 2 else canvas
    if fix.T_dock_cam is not None:
        _draw_projected(canvas, project_lights(camera, fix.T_dock_cam, station.p_dock), station, crop)
    if fix.match is not None:
        _draw_detections(canvas, fix.match, station, crop)
    _draw_caption(canvas, fix)
    return canvas


def _draw_projected(canvas: Image, uv: Array, station: Station, crop: Crop) -> None:
    """A small cross where the pose puts each light."""
    for light, at in enumerate(uv):
        if np.isfinite(at).all() and (np.abs(at) < 1e4).all():
            color = bgr(of_layer(station, light))
            cv2.drawMarker(canvas, crop.at(at), color, cv2.MARKER_TILTED_CROSS, 8, 1, cv2.LINE_AA)


def _draw_detections(canvas: Image, match: Match, station: Station, crop: Crop) -> None:
    """A ring around each detection that is shown, with the id of its light; red where it is spurious."""
    detections = match.detections
    for k in shown_detections(match):
        (u, v), light = crop.at(detections.uv[k]), int(match.light[k])
        ring, color = ring_px(float(detections.radius_px[k]), crop), bgr(of_layer(station, light))
        cv2.circle(canvas, (u, v), round(ring), color, 1, cv2.LINE_AA)
        if light >= 0:
            _write(canvas, station.ids[light], (u + round(ring) + 3, v - 4), color, 0.5)


def ring_px(radius_px: float, crop: Crop) -> float:
    """Radius on the canvas of the ring around a detection of `radius_px`, which leaves the blob itself visible."""
    return max(9.0, 1.6 * float(np.nan_to_num(radius_px)) * crop.scale + 5.0)


def _draw_caption(canvas: Image, fix: Fix) -> None:
    first = f"frame {fix.frame}   {fix.stage}   {fix.status}   {fix.n_used} lights used, {fix.n_seen} detections"
    _write(canvas, first, (14, 28), _TEXT, 0.62)
    if fix.T_dock_cam is not None:
        x, y, z = fix.T_dock_cam[:3, 3]
        _write(canvas, f"x {x:+.2f}   y {y:+.2f}   z {z:+.2f} m", (14, 56), _TEXT, 0.62)
    elif fix.guide is not None:
        x, y = np.rad2deg([fix.guide.bearing_x_rad, fix.guide.bearing_y_rad])
        text = f"bearing {x:+.2f}, {y:+.2f} deg   range {fix.guide.range_m:.2f} m   no pose: {fix.reason}"
        _write(canvas, text, (14, 56), _TEXT, 0.62)
    else:
        _write(canvas, f"no fix: {fix.reason}", (14, 56), bgr(SPURIOUS_ON_WATER), 0.62)


def _write(canvas: Image, text: str, at: tuple[int, int], color: tuple[int, int, int], size: float) -> None:
    """A line of text on a darkened ground, so that it can be read on a bright halo too; kept inside the canvas."""
    (width, height), below = cv2.getTextSize(text, _FONT, size, 1)
    x = max(0, min(at[0], canvas.shape[1] - width - 3))
    y = max(height + 3, min(at[1], canvas.shape[0] - below))
    ground = canvas[y - height - 3 : y + below, max(x - 3, 0) : x + width + 3]
    ground[...] = (ground * _SHADE).astype(np.uint8)
    cv2.putText(canvas, text, (x, y), _FONT, size, color, 1, cv2.LINE_AA)

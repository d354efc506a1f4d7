"""A film of one docking: the camera's picture with the fix drawn on it, and beside it the vehicle in the cage."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from lumidock.datatypes import Array, Image
from lumidock.docking.loop import Docking, Moment, camera_of
from lumidock.docking.vehicle import R_BODY_CAM_AHEAD
from lumidock.picture import developed
from lumidock.sim.rendered_camera import RenderedCamera, scaled
from lumidock.streams.colors import ON_WATER, bgr
from lumidock.streams.overlay import brightened
from lumidock.streams.sinks import open_video

_SHARE = 0.25  # of the camera's width; a picture of the whole sensor takes seconds
_MOST_PICTURES = 150  # of a film
_SIDE_M, _AHEAD_M, _BEHIND_M = 2.5, 6.0, 12.0  # what the plan shows beside, before and behind the entrance
_COLORS = {"go": "#4cc38a", "hold": "#ffc24a", "abort": "#ff5a5f"}
_INK, _GROUND, _FONT = (225, 225, 225), (38, 28, 20), cv2.FONT_HERSHEY_SIMPLEX
_SHADE = 0.35  # of its brightness is left of the picture behind a text
_HULL = bgr("#e29bff")


def film(docking: Docking, moments: Sequence[Moment], path: Path) -> None:
    """Write the film, each picture at its own time. Raises: InputError without the extra `video`."""
    every = math.ceil(len(moments) / _MOST_PICTURES)
    writer = open_video(path)
    eye = RenderedCamera(camera_of(docking, scaled(docking.camera, _SHARE), len(moments)), docking.seed)
    try:
        for number in range(0, len(moments), every):
            moment = moments[number]
            frame = eye.see(number, moment.T_dock_cam)
            picture = brightened(developed(frame))[0]
            view = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture.copy()
            _rings(view, moment, docking)
            _captions(view, moment)
            writer.add(np.hstack([view, plan(docking, moment, view.shape[0])]), frame.t_ns)
    finally:
        writer.close()


def _rings(view: Image, moment: Moment, docking: Docking) -> None:
    """A ring around each detection, in the colour of its light's layer; red where it is none."""
    if moment.fix is None or moment.fix.match is None:
        return
    match = moment.fix.match
    for (u, v), light in zip(match.detections.uv * _SHARE, match.light.tolist(), strict=True):
        color = bgr(ON_WATER[docking.station.layer_rank(light) % 4]) if light >= 0 else bgr("#ff5a5f")
        cv2.circle(view, (round(float(u)), round(float(v))), 8, color, 1, cv2.LINE_AA)


def _captions(view: Image, moment: Moment) -> None:
    advice, fix = moment.step.advice, moment.fix
    z, off = moment.T_dock_cam[2, 3], math.hypot(*moment.T_dock_cam[:2, 3])
    told = "no frame" if fix is None else "valid" if fix.valid else f"no pose: {fix.reason}"
    lines = [
        (f"{moment.t_s:5.1f} s   {moment.step.state}", _INK),
        (f"{advice.verdict}: {advice.word}", bgr(_COLORS[advice.verdict])),
        (f"truth: z {z:+.2f} m, {off:.2f} m off the axis", _INK),
        (f"{told}   level {min(moment.level_m, 99.0):.2f} m", _INK),
    ]
    for k, (text, color) in enumerate(lines):
        (width, height), below = cv2.getTextSize(text, _FONT, 0.48, 1)
        ground = view[20 + 20 * k - height - 2 : 20 + 20 * k + below, 6 : 14 + width]
        ground[...] = (ground * _SHADE).astype(np.uint8)
        cv2.putText(view, text, (10, 20 + 20 * k), _FONT, 0.48, color, thickness=1, lineType=cv2.LINE_AA)


def plan(docking: Docking, moment: Moment, height: int) -> Image:
    """The vehicle and the cage from above and from the side, `height` high; up on the picture is into the dock."""
    scale = height / (_AHEAD_M + _BEHIND_M)
    width = round(2.0 * _SIDE_M * scale)
    return np.hstack([_panel(docking, moment, axis, (height, width), scale) for axis in (0, 1)])


def _panel(docking: Docking, moment: Moment, axis: int, size: tuple[int, int], scale: float) -> Image:
    canvas = np.full((*size, 3), _GROUND, np.uint8)

    def at(p_dock: Array) -> tuple[int, int]:
        return round(size[1] / 2 + float(p_dock[axis]) * scale), round((_BEHIND_M + float(p_dock[2])) * scale)

    corners = [np.array([s, s, z]) for z in (0.0, -5.0) for s in (-1.0, 1.0)]
    for a, b in ((0, 2), (1, 3), (2, 3)):
        cv2.line(canvas, at(corners[a]), at(corners[b]), _INK, 1, cv2.LINE_AA)
    for light, p_dock in enumerate(docking.station.p_dock):
        cv2.circle(canvas, at(p_dock), 2, bgr(ON_WATER[docking.station.layer_rank(light) % 4]), -1, cv2.LINE_AA)
    cv2.circle(canvas, at(docking.station.docking_point), 5, _INK, 1, cv2.LINE_AA)
    cv2.polylines(canvas, [_hull(docking, moment, axis, at)], True, _HULL, 1, cv2.LINE_AA)
    name = ("from above", "from the side")[axis]
    cv2.putText(canvas, name, (6, size[0] - 8), _FONT, 0.4, _INK, thickness=1, lineType=cv2.LINE_AA)
    return np.asarray(canvas)


def _hull(docking: Docking, moment: Moment, axis: int, at: Callable[[Array], tuple[int, int]]) -> Array:
    """Corners (4, 2) px of the hull's outline, seen along the other axis."""
    T, half = moment.T_dock_cam, docking.vehicle.half_m
    R_dock_body = T[:3, :3] @ R_BODY_CAM_AHEAD.T
    middle = T[:3, 3] - R_dock_body[:, 0] * half[0]
    side = R_dock_body[:, 1 + axis] * half[1 + axis]
    ahead = R_dock_body[:, 0] * half[0]
    return np.array([at(middle + a * ahead + s * side) for a, s in ((1, -1), (1, 1), (-1, 1), (-1, -1))], np.int32)

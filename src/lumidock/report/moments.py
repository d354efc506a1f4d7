"""Camera views of a run at the moments that tell most, with what was turned down and why."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from lumidock.datatypes import Array, Detections, Fix, Frame, Image, Match
from lumidock.picture import developed
from lumidock.pose import project_lights
from lumidock.report.page import Mark, Picture
from lumidock.report.view import RunView
from lumidock.station import Station
from lumidock.streams.overlay import View, around_lights, whole
from lumidock.streams.sources import Item

_WIDTH, _QUALITY = 760, 82
_BRIGHT, _MOST_GAIN = 220.0, 5.0  # grey level that the brightest spots are brought to
_NEAR_PX = 40.0  # a spot so near to a predicted light is told by it
_UNLIKELY = 0.5
_MOST_NOTES = 6
_LAYER_COLORS = ("#ffc24a", "#62b5ff", "#7dff8a", "#e29bff")  # on dark water
_REJECTED = "#ff5a5f"


def pictures(view: RunView, most: int) -> list[Picture]:
    """At most `most` annotated pictures, in the order of the run; none where the source has no frames at hand."""
    if view.source is None or view.source.kind == "detections" or not most:
        return []
    return pictures_of(view, dict(sorted(_moments(view)[:most])))


def pictures_of(view: RunView, wanted: dict[int, str]) -> list[Picture]:
    """Annotated pictures of the frames `wanted`, by their number, with their titles."""
    if view.source is None or view.source.kind == "detections":
        return []
    return [_picture(view, view.fixes[k], developed(item), title) for k, title, item in _items(view, wanted)]


def _items(view: RunView, wanted: dict[int, str]) -> Iterator[tuple[int, str, Frame]]:
    """The frames that are wanted, with their titles, as the source gives them."""
    assert view.source is not None
    items: Iterator[Item] = view.source.items()
    last = max(wanted, default=-1)
    for k, item in enumerate(items):
        if k in wanted and isinstance(item, Frame):
            yield k, wanted[k], item
        if k >= last:
            return


def _moments(view: RunView) -> list[tuple[int, str]]:
    """Frames worth looking at and why, the most telling first, none twice."""
    found: dict[int, str] = {}
    for k, why in _candidates(view):
        if k is not None:
            found.setdefault(int(k), why)
    return list(found.items())


def _candidates(view: RunView) -> Iterator[tuple[int | None, str]]:
    valid, guided = view.valid, view.guided
    stage = np.array([fix.stage for fix in view.fixes])
    usable = valid | guided
    yield _first(valid), "First valid pose"
    yield (
        _middle(np.flatnonzero(~usable & (np.cumsum(usable) > 0) & (np.cumsum(usable[::-1])[::-1] > 0))),
        "No fix on the way",
    )
    yield _last(valid), "Last valid pose"
    if np.isfinite(view.errors).any():
        yield int(np.nanargmax((view.errors / view.limits).max(axis=1))), "Largest error for its alert limit"
    yield _first(usable & (stage == "transition")), "Hand-over: both layers"
    yield _first(usable & (stage == "rear")), "Rear layer alone"
    rejected = np.array([0 if fix.match is None else int((fix.match.light < 0).sum()) for fix in view.fixes])
    yield (int(rejected.argmax()) if rejected.max() else None), "Most detections turned down"
    yield _first(guided), "First bearing and range"
    yield _middle(np.flatnonzero(valid & (stage == "front"))), "On the front layer"
    yield _middle(np.flatnonzero(~usable)), "No fix"
    yield len(view.fixes) // 2, "Half-way"


def _first(which: np.ndarray) -> int | None:
    return int(which.argmax()) if which.any() else None


def _last(which: np.ndarray) -> int | None:
    return int(np.flatnonzero(which)[-1]) if which.any() else None


def _middle(frames: np.ndarray) -> int | None:
    return int(frames[len(frames) // 2]) if len(frames) else None


def _picture(view: RunView, fix: Fix, image: Image, title: str) -> Picture:
    part = _part(image, fix)
    window = image[part.v : part.v + part.height, part.u : part.u + part.width]
    size = (_WIDTH, round(part.height * part.scale))
    resized = cv2.resize(window, size, interpolation=cv2.INTER_AREA if part.scale < 1 else cv2.INTER_LINEAR)
    small, gain = _brightened(np.asarray(resized, np.uint8))
    done, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    predicted = _predicted(view, fix)
    rejected = _rejections(fix, view.station, predicted)
    marks = [*_crosses(view.station, predicted, part), *_rings(fix, view.station, part, rejected)]
    notes = _notes(list(rejected.values()))
    inside = [m for m in marks if -20 < m.x < size[0] + 20 and -20 < m.y < size[1] + 20]
    shown = "all of the picture" if part.width == image.shape[1] else f"{part.width} of {image.shape[1]} px across"
    shown += f", contrast times {gain:.1f}" if gain > 1.0 else ""
    encoded = base64.b64encode(jpeg.tobytes()).decode()
    return Picture(title, f"{_sentence(fix, view)} ({shown})", encoded, *size, inside, notes)


def _notes(why: list[str]) -> list[str]:
    """A line for each reason, with the numbers of the rings that it holds for."""
    numbers: dict[str, list[str]] = {}
    for number, reason in enumerate(why, start=1):
        numbers.setdefault(reason, []).append(str(number))
    notes = [f"{', '.join(of)}: {reason}" for reason, of in numbers.items()]
    more = len(notes) - _MOST_NOTES
    return notes if more <= 0 else [*notes[:_MOST_NOTES], f"and {more} more reasons"]


def _brightened(image: Image) -> tuple[Image, float]:
    """A picture in which a person sees the brightest spots, and by what its contrast was multiplied."""
    brightest = float(np.percentile(image, 99.98))
    water = 0.7 * float(np.median(image))
    gain = min(_MOST_GAIN, _BRIGHT / max(brightest - water, 1.0))
    if brightest > _BRIGHT / 1.1:
        return image, 1.0
    return np.clip((image.astype(np.float32) - water) * gain, 0.0, 255.0).astype(np.uint8), gain


def _part(image: Image, fix: Fix) -> View:
    """Around the lights that were named; the whole picture without any."""
    if fix.match is None or not (fix.match.light >= 0).any():
        return whole(image, _WIDTH)
    named = fix.match.light >= 0
    detections = Detections.from_uv(fix.frame, fix.t_ns, fix.match.detections.uv[named])
    return around_lights(image, replace(fix, match=Match(detections, fix.match.light[named])), _WIDTH)


def _predicted(view: RunView, fix: Fix) -> Array:
    """Where the pose puts each light (M, 2) px, NaN without a pose."""
    if fix.T_dock_cam is None:
        return np.full((len(view.station.ids), 2), np.nan)
    return project_lights(view.camera, fix.T_dock_cam, view.station.p_dock)


def _color(station: Station, light: int) -> str:
    layers = station.layers_front_to_rear()
    return _LAYER_COLORS[layers.index(station.layers[station.layer[light]]) % len(_LAYER_COLORS)]


def _crosses(station: Station, predicted: Array, part: View) -> Iterator[Mark]:
    for light, uv in enumerate(predicted):
        if np.isfinite(uv).all() and (np.abs(uv) < 1e5).all():
            x, y = map(float, part.at(uv))
            yield Mark(x, y, 0.0, "", _color(station, light))


def _rings(fix: Fix, station: Station, part: View, rejected: dict[int, str]) -> Iterator[Mark]:
    if fix.match is None:
        return
    number = {detection: str(n) for n, detection in enumerate(rejected, start=1)}
    detections = fix.match.detections
    for k, (uv, radius, light) in enumerate(
        zip(detections.uv, detections.radius_px, fix.match.light.tolist(), strict=True)
    ):
        ring = max(8.0, round(1.6 * float(np.nan_to_num(radius)) * part.scale, 1) + 4.0)
        x, y = map(float, part.at(uv))
        name, color = (station.ids[light], _color(station, light)) if light >= 0 else (number[k], _REJECTED)
        yield Mark(x, y, ring, name, color)


def _rejections(fix: Fix, station: Station, predicted: Array) -> dict[int, str]:
    """Why each detection without a name has none, by its number; told from what the run's files say."""
    if fix.match is None:
        return {}
    detections, light = fix.match.detections, fix.match.light
    named = {station.ids[i] for i in light.tolist() if i >= 0}
    return {
        int(k): _why(detections.uv[k], float(detections.p_light[k]), fix, station, predicted, named)
        for k in np.flatnonzero(light < 0)
    }


def _why(uv: Array, p_light: float, fix: Fix, station: Station, predicted: Array, named: set[str]) -> str:
    if p_light < _UNLIKELY:
        return f"hardly a lamp: probability {p_light:.2f}"
    if fix.T_dock_cam is None:
        return "fits none of the named lights" if named else "no lights could be named in this frame"
    away = np.linalg.norm(predicted - uv, axis=1)
    if not np.isfinite(away).any():
        return "no light of the dock is in view"
    nearest = int(np.nanargmin(away))
    name, px = station.ids[nearest], float(away[nearest])
    if px > _NEAR_PX:
        return f"{px:.0f} px from the nearest light, {name}"
    taken = ", which another detection has" if name in named else ", not near enough or not in use"
    return f"{px:.1f} px from where {name} should be{taken}"


def _sentence(fix: Fix, view: RunView) -> str:
    k = next(i for i, other in enumerate(view.fixes) if other is fix)
    start = f"Frame {fix.frame}, {view.t_s[k]:.2f} s, {fix.stage}, {fix.status}: "
    if fix.T_dock_cam is not None:
        x, y, z = fix.T_dock_cam[:3, 3]
        return f"{start}x {x:+.2f}, y {y:+.2f}, z {z:+.2f} m by {fix.n_used} of {fix.n_seen} detections."
    reason = fix.reason.replace("_", " ")
    if fix.guide is not None:
        x, y = np.rad2deg([fix.guide.bearing_x_rad, fix.guide.bearing_y_rad])
        return f"{start}bearing {x:+.2f}, {y:+.2f} deg, range {fix.guide.range_m:.2f} m; no pose: {reason}."
    return f"{start}no fix: {reason}."

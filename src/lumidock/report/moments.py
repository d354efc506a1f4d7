"""Annotated images of a run at the moments that tell most, with the reason for each detection that was not used."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lumidock.datatypes import Array, Fix, Frame, Image
from lumidock.evaluation.run_description import frame_in_source
from lumidock.picture import developed
from lumidock.pose import project_lights
from lumidock.report.page import AnnotatedImage, Mark
from lumidock.report.view import RunView
from lumidock.station import Station
from lumidock.streams.colors import SPURIOUS_ON_WATER, of_layer
from lumidock.streams.overlay import (
    LEAST_P_LIGHT,
    Crop,
    around_lights,
    brightened,
    ring_px,
    shown_detections,
)

_WIDTH, _QUALITY = 760, 82  # px; of JPEG
_NEAR_PX = 40.0  # a detection so near to a projected light is described by its distance from it
_UNLIKELY = 0.5  # probability of being a lamp below which that is the reason for not using a detection
_MOST_NOTES = 6
_LABEL_PX = 30.0  # of the picture: nearer to each other than this two labels would overlap


def annotated_images(view: RunView, most: int) -> list[AnnotatedImage]:
    """At most `most` images: the most telling one, then others as they came in time, an even number of them.

    None where the source has no frames at hand.
    """
    if view.source is None or view.source.kind == "detections" or not most:
        return []
    first, *others = _moments(view)[:most]
    if len(others) > 1:
        others = others[: len(others) // 2 * 2]  # they stand in two columns
    return images_of(view, [first, *sorted(others)])


def images_of(view: RunView, chosen: list[tuple[int, str]]) -> list[AnnotatedImage]:
    """Annotated images of the frames `chosen`, number and title of each, in their order."""
    if view.source is None or view.source.kind == "detections":
        return []
    frames = dict(_items(view, sorted(k for k, _ in chosen)))
    return [_annotated(view, view.fixes[k], developed(frames[k]), title) for k, title in chosen if k in frames]


def _items(view: RunView, wanted: list[int]) -> Iterator[tuple[int, Frame]]:
    """The frames that are wanted, by their numbers in the run, in the order of the source."""
    assert view.source is not None
    names = {view.fixes[k].frame: k for k in wanted}
    left = len(wanted)
    for item in view.source.items():
        if not left:
            return
        name = item.name if isinstance(item, Frame) else item.frame
        for frame, k in names.items():
            if name in (frame, frame_in_source(frame, {name})):
                left -= 1
                if isinstance(item, Frame):
                    yield k, item


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
    for name, layers in (("front", "the front layer"), ("transition", "both layers")):
        if (valid & (stage == name)).any():
            yield _middle(np.flatnonzero(valid & (stage == name))), f"Approach on {layers}"
            break
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
    unused = np.array([_unused(fix) for fix in view.fixes])
    yield (int(unused.argmax()) if unused.max() else None), "Most detections that were not used"
    yield _first(guided), "First bearing and range"
    yield _middle(np.flatnonzero(~usable)), "No fix"
    yield len(view.fixes) // 2, "Half-way"


def _unused(fix: Fix) -> int:
    """Detections that may be lamps and were not identified as a light."""
    return 0 if fix.match is None else int((fix.match.light[shown_detections(fix.match)] < 0).sum())


def _first(which: np.ndarray) -> int | None:
    return int(which.argmax()) if which.any() else None


def _last(which: np.ndarray) -> int | None:
    return int(np.flatnonzero(which)[-1]) if which.any() else None


def _middle(frames: np.ndarray) -> int | None:
    return int(frames[len(frames) // 2]) if len(frames) else None


def _annotated(view: RunView, fix: Fix, image: Image, title: str) -> AnnotatedImage:
    crop = around_lights(image, fix, _WIDTH)
    small, gain = brightened(crop.cut(image), crop.scale)
    done, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    height, width = small.shape[:2]
    projected = _projected(view, fix)
    unused = _numbered(_reasons(fix, view.station, projected), fix, crop)
    marks = [*_crosses(view.station, projected, crop), *_rings(fix, view.station, crop, unused)]
    inside = [m for m in marks if -20 < m.x < width + 20 and -20 < m.y < height + 20]
    shown = "whole image" if crop.width == image.shape[1] else f"{crop.width} of {image.shape[1]} px across"
    shown += f", contrast raised {gain:.1f} times" if gain > 1.0 else ""
    return AnnotatedImage(
        title=title,
        caption=f"{_sentence(fix, view)} ({shown})",
        jpeg_base64=base64.b64encode(jpeg.tobytes()).decode(),
        width=width,
        height=height,
        marks=inside,
        notes=_notes(fix, unused),
    )


def _notes(fix: Fix, unused: Sequence[_Unused]) -> list[str]:
    """A line for each reason, with the numbers of the rings that it holds for; and how many have no ring."""
    numbers: dict[str, list[int]] = {}
    for one in unused:
        for why in one.why:
            numbers.setdefault(why, []).append(one.number)
    notes = [f"{', '.join(map(str, dict.fromkeys(of)))}: {why}" for why, of in numbers.items()]
    more = len(notes) - _MOST_NOTES
    if more > 0:
        notes = [*notes[:_MOST_NOTES], f"and {more} more reason{'s' * (more > 1)}"]
    hidden = 0 if fix.match is None else len(fix.match.light) - len(shown_detections(fix.match))
    if hidden:
        more_text = "1 more detection, a lamp" if hidden == 1 else f"{hidden} more detections, each a lamp"
        notes.append(f"{more_text} with a probability below {LEAST_P_LIGHT:g}, without a ring")
    return notes


def _projected(view: RunView, fix: Fix) -> Array:
    """Where the pose puts each light (M, 2) px, NaN without a pose."""
    if fix.T_dock_cam is None:
        return np.full((len(view.station.ids), 2), np.nan)
    return project_lights(view.camera, fix.T_dock_cam, view.station.p_dock)


def _crosses(station: Station, projected: Array, crop: Crop) -> Iterator[Mark]:
    for light, uv in enumerate(projected):
        if np.isfinite(uv).all() and (np.abs(uv) < 1e5).all():
            x, y = map(float, crop.at(uv))
            yield Mark(x, y, 0.0, "", of_layer(station, light))


def _rings(fix: Fix, station: Station, crop: Crop, unused: Sequence[_Unused]) -> Iterator[Mark]:
    if fix.match is None:
        return
    number = {one.detections[0]: str(one.number) for one in unused}
    detections, light, shown = fix.match.detections, fix.match.light, shown_detections(fix.match).tolist()
    at = np.array([crop.at(uv) for uv in detections.uv], float).reshape(-1, 2)
    identified = at[[k for k in shown if light[k] >= 0]]
    for k in sorted(shown, key=lambda k: k in number):  # rings with a number last, so that no other hides it
        x, y = map(float, at[k])
        ring = round(ring_px(float(detections.radius_px[k]), crop), 1)
        if light[k] >= 0:
            yield Mark(x, y, ring, station.ids[light[k]], of_layer(station, int(light[k])))
        else:  # the id of a light beside it stands on the right
            crowded = bool((np.linalg.norm(identified - at[k], axis=1) < _LABEL_PX).any())
            yield Mark(x, y, ring, number.get(k, ""), SPURIOUS_ON_WATER, on_left=crowded)


@dataclass(frozen=True, slots=True)
class _Unused:
    """Detections that were not used and that one label serves, since their rings overlap; and why each was not."""

    number: int
    detections: tuple[int, ...]
    why: tuple[str, ...]


def _numbered(reasons: dict[int, str], fix: Fix, crop: Crop) -> list[_Unused]:
    """The unused detections, those whose labels would overlap under one number."""
    groups: list[list[int]] = []
    if fix.match is None:
        return []
    at = {k: np.asarray(crop.at(fix.match.detections.uv[k])) for k in reasons}
    for k in reasons:
        near = (group for group in groups if np.linalg.norm(at[k] - at[group[0]]) < _LABEL_PX)
        group = next(near, None)
        if group is None:
            groups.append([k])
        else:
            group.append(k)
    return [_Unused(n, tuple(of), tuple(reasons[k] for k in of)) for n, of in enumerate(groups, start=1)]


@dataclass(frozen=True, slots=True, eq=False)
class _Identified:
    """What explains an unused detection: the projected lights (M, 2) px, and the ids that other detections have."""

    station: Station
    projected: Array
    ids: set[str]


def _reasons(fix: Fix, station: Station, projected: Array) -> dict[int, str]:
    """Why each detection with a ring was not identified, by its number; as far as the run's files tell."""
    if fix.match is None:
        return {}
    detections, light = fix.match.detections, fix.match.light
    others = _Identified(station, projected, {station.ids[i] for i in light.tolist() if i >= 0})
    return {
        k: _why(detections.uv[k], float(detections.p_light[k]), fix, others)
        for k in shown_detections(fix.match).tolist()
        if light[k] < 0
    }


def _why(uv: Array, p_light: float, fix: Fix, others: _Identified) -> str:
    if p_light < _UNLIKELY:
        return f"probably no lamp (probability below {_UNLIKELY:g})"
    if fix.T_dock_cam is None:
        return "fits none of the identified lights" if others.ids else "no light could be identified in this frame"
    away = np.linalg.norm(others.projected - uv, axis=1)
    if not np.isfinite(away).any():
        return "no light of the dock is in view"
    nearest = int(np.nanargmin(away))
    light, px = others.station.ids[nearest], float(away[nearest])
    if px > _NEAR_PX:
        return f"{px:.0f} px from the nearest light, {light}"
    taken = ", which another detection is" if light in others.ids else ", outside its gate or not in use"
    return f"{px:.1f} px from where {light} should be{taken}"


def _sentence(fix: Fix, view: RunView) -> str:
    k = next(i for i, other in enumerate(view.fixes) if other is fix)
    start = f"Frame {fix.frame}, {view.t_s[k]:.2f} s, {fix.stage}, {fix.status}: "
    if fix.T_dock_cam is not None:
        x, y, z = fix.T_dock_cam[:3, 3]
        return f"{start}x {x:+.2f}, y {y:+.2f}, z {z:+.2f} m from {fix.n_used} lights; {fix.n_seen} detections."
    reason = fix.reason.replace("_", " ")
    if fix.guide is not None:
        x, y = np.rad2deg([fix.guide.bearing_x_rad, fix.guide.bearing_y_rad])
        return f"{start}bearing {x:+.2f}, {y:+.2f} deg, range {fix.guide.range_m:.2f} m; no pose: {reason}."
    return f"{start}no fix: {reason}."

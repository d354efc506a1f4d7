"""What a survey sees: which light was detected where, in the frames of one or more recordings of the same dock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Indices, Match
from lumidock.errors import InputError
from lumidock.localizer import Localizer
from lumidock.station import Station

LEAST_LIGHTS = 4  # three lights fit up to four poses, so a frame with fewer than four says nothing of positions
Progress = Callable[[int, int | None], None]
_SAME_PX = 1.0  # between a label and its detection: a run keeps hundredths, and lights stand apart by more
_ANY_ROLL = 1e-9  # share of approaches with any roll, the least that `prior.any_roll` takes


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Identified lights in F frames; M lights.

    `uv` (F, M, 2) px, NaN where a light was not detected; `sigma_px` (F, M) the 1-sigma error of each centre as the
    detector states it, or as configured where it states none; `recording` (F,), `t_ns` (F,) and `frame` (F,) say when.
    `share` is the part of the frames between the first and the last identified one of a recording that were identified.
    """

    uv: Array
    sigma_px: Array
    recording: Indices
    t_ns: Indices
    frame: tuple[str, ...]
    share: float = 1.0

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def seen(self) -> np.ndarray:
        """Which lights (F, M) were detected."""
        return np.asarray(np.isfinite(self.uv[..., 0]))

    def take(self, frames: Indices) -> Self:
        """The frames at these indices alone."""
        return type(self)(
            self.uv[frames],
            self.sigma_px[frames],
            self.recording[frames],
            self.t_ns[frames],
            tuple(self.frame[i] for i in frames),
            self.share,
        )

    def without(self, rejected: np.ndarray) -> Self:
        """The same without the detections where `rejected` (F, M)."""
        uv = np.where(rejected[..., None], np.nan, self.uv)
        return type(self)(uv, self.sigma_px, self.recording, self.t_ns, self.frame, self.share)


@dataclass(frozen=True, slots=True)
class Labelled:
    """A detection at `uv` px that a person has identified as the light with this index, in a frame of a recording."""

    frame: str
    uv: tuple[float, float]
    light: int
    recording: int = 0


def identify(
    recordings: Sequence[Iterable[Detections]],
    station: Station,
    camera: Camera,
    config: Config,
    progress: Progress | None = None,
    *,
    labels: Sequence[Labelled] = (),
) -> Observations:
    """Associate the detections of each recording with the lights of `station`, as the localizer does.

    A frame of which `labels` tell has these alone.

    The station's declared sigmas decide how far a light may lie from where the file has it. Frames in which fewer than
    four lights are identified are left out. The vehicle is taken to be as upright as the prior says: a drawing of a
    regular ring would fit itself turned, and no survey could begin.
    """
    upright = config.prior.model_copy(update={"any_roll": min(_ANY_ROLL, config.prior.any_roll)})
    config = config.model_copy(update={"prior": upright})
    rows: list[_Row | None] = []
    told = _by_frame(labels)
    done = spans = 0
    for number, recording in enumerate(recordings):
        localizer, first = Localizer(station, camera, config), len(rows)
        for detections in recording:
            fix, here = localizer.process_detections(detections), told.get((number, detections.frame))
            match = fix.match if here is None else _told_match(detections, here)
            rows.append(_row(number, match, len(station), config.match.noise_px))
            done += 1
            if progress is not None:
                progress(done, None)
        found = [k for k, row in enumerate(rows[first:]) if row is not None]
        spans += found[-1] - found[0] + 1 if found else 0
    kept = [row for row in rows if row is not None]
    together = _together(kept, len(station))
    return replace(together, share=len(kept) / spans) if kept else together


def labelled(
    recordings: Sequence[Iterable[Detections]], station: Station, labels: Sequence[Labelled], noise_px: float
) -> Observations:
    """The frames of which `labels` tell. Raises: InputError for a label of a frame or detection that is not there."""
    told, rows = _by_frame(labels), list[_Row]()
    for number, recording in enumerate(recordings):
        for detections in recording:
            here = told.pop((number, detections.frame), None)
            row = None if here is None else _row(number, _told_match(detections, here), len(station), noise_px)
            if row is not None:
                rows.append(row)
            elif here is not None:
                raise InputError(
                    f"frame {detections.frame}: {len(here)} lights labelled, wanted at least {LEAST_LIGHTS}"
                )
    for _, frame in told:
        raise InputError(f"frame {frame}: labelled, but not in the recording")
    return _together(rows, len(station))


def _by_frame(labels: Sequence[Labelled]) -> dict[tuple[int, str], list[Labelled]]:
    told: dict[tuple[int, str], list[Labelled]] = {}
    for label in labels:
        told.setdefault((label.recording, label.frame), []).append(label)
    return told


def _told_match(detections: Detections, labels: list[Labelled]) -> Match:
    """The association of a frame as a person gave it. Raises: InputError for a place without a detection."""
    light = np.full(len(detections), -1, np.int64)
    for label in labels:
        away = np.linalg.norm(detections.uv - np.array(label.uv), axis=1)
        if not len(away) or away.min() > _SAME_PX:
            u, v = label.uv
            raise InputError(f"frame {label.frame}: no detection at {u:.1f}, {v:.1f} px")
        light[int(away.argmin())] = label.light
    return Match(detections, light)


def _together(rows: Sequence[_Row], m: int) -> Observations:
    """The rows as one table, of `m` lights."""
    if not rows:
        return Observations(np.empty((0, m, 2)), np.empty((0, m)), *(np.empty(0, np.int64),) * 2, ())
    return Observations(
        np.array([row.uv for row in rows]),
        np.array([row.sigma_px for row in rows]),
        np.array([row.recording for row in rows], np.int64),
        np.array([row.t_ns for row in rows], np.int64),
        tuple(row.frame for row in rows),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    uv: Array
    sigma_px: Array
    recording: int
    t_ns: int
    frame: str


def _row(recording: int, match: Match | None, m: int, noise_px: float) -> _Row | None:
    if match is None or (match.light >= 0).sum() < LEAST_LIGHTS:
        return None
    light, d = match.light, match.detections
    used = light >= 0
    uv, sigma = np.full((m, 2), np.nan), np.full(m, noise_px)
    uv[light[used]] = d.uv[used]
    if d.cov_px2 is not None:
        sigma[light[used]] = np.sqrt(0.5 * np.trace(d.cov_px2[used], axis1=1, axis2=2))
    return _Row(uv, sigma, recording, d.t_ns, d.frame)

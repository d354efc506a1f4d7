"""A run: every item of a source through a localizer into a run folder."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lumidock.config import Config
from lumidock.datatypes import Fix, Frame, Stage, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.methods import Aided, Method
from lumidock.streams.run_folder import RunFolder, identities
from lumidock.streams.sensors import AidingFeed, SensorFeed
from lumidock.streams.source import Item, Source

_RENEWED_S = 1.0  # between two writings of run.json while a run goes on
_START: Stage = "search"


@dataclass(frozen=True, slots=True)
class Contradicted:
    """In how many `frames` one thing in a file was contradicted, and the last of them in words."""

    frames: int
    text: str


@dataclass(slots=True)
class OverLimit:
    """In how many `frames` one protection level was over its alert limit, and the `least` and `most` factor by it."""

    frames: int = 0
    least: float = math.inf
    most: float = 0.0

    def count(self, factor: float) -> None:
        """Add one frame."""
        self.frames, self.least, self.most = self.frames + 1, min(self.least, factor), max(self.most, factor)


@dataclass(slots=True)
class Summary:
    """Counts of a run, as they stand in run.json."""

    frames: int = 0
    usable: int = 0
    valid: int = 0
    guide: int = 0
    guide_only: int = 0
    status: Counter[str] = field(default_factory=Counter)
    stage: Counter[str] = field(default_factory=Counter)
    reason: Counter[str] = field(default_factory=Counter)
    exposure_frames: int = 0
    too_bright: int = 0
    too_dark: int = 0
    log_exposure_factor: float = 0.0  # sum over these frames
    contradictions: dict[tuple[str, str], Contradicted] = field(default_factory=dict)
    over_limit: dict[str, OverLimit] = field(default_factory=dict)
    nis_sum: float = 0.0
    nis_frames: int = 0
    latency_us: Counter[int] = field(default_factory=Counter)  # how often each occurred: a server runs for weeks
    first_error: str = ""
    finished: bool = False

    def count(self, fix: Fix, latency_us: int | None, error: str) -> None:
        """Add one frame."""
        self.frames += 1
        self.usable += fix.reason not in ("bad_frame", "bad_stamp")
        self.valid += fix.valid
        self.guide += fix.guide is not None
        self.guide_only += fix.guide is not None and not fix.valid
        self.status[fix.status] += 1
        self.stage[fix.stage] += fix.valid
        self.reason[fix.reason] += bool(fix.reason)
        self.first_error = self.first_error or error
        if fix.excess is not None and math.isfinite(fix.excess.factor):
            self.over_limit.setdefault(fix.excess.of, OverLimit()).count(fix.excess.factor)
        if (against := fix.contradiction) is not None:
            key = against.file, against.subject
            before = self.contradictions.get(key)
            self.contradictions[key] = Contradicted(before.frames + 1 if before else 1, against.text)
        if math.isfinite(fix.nis):
            self.nis_sum, self.nis_frames = self.nis_sum + fix.nis, self.nis_frames + 1
        if math.isfinite(fix.exposure_factor):
            self.exposure_frames += 1
            self.too_bright += fix.exposure_factor < 1.0
            self.too_dark += fix.exposure_factor > 1.0
            self.log_exposure_factor += math.log(fix.exposure_factor)
        if latency_us is not None:
            self.latency_us[latency_us] += 1

    def as_dict(self) -> dict[str, Any]:
        """For run.json; latency in microseconds, decoding excluded."""
        return {
            "frames": self.frames,
            "usable": self.usable,
            "valid": self.valid,
            "guide": self.guide,
            "guide_only": self.guide_only,
            "status": dict(self.status),
            "valid_by_stage": {name: count for name, count in self.stage.items() if count},
            "reason": {name: count for name, count in self.reason.items() if count},
            "over_limit": {
                of: {"frames": one.frames, "least": round(one.least, 3), "most": round(one.most, 3)}
                for of, one in sorted(self.over_limit.items())
            },
            "contradictions": [
                {"file": file, "subject": subject, "frames": one.frames, "text": one.text}
                for (file, subject), one in sorted(self.contradictions.items(), key=lambda item: -item[1].frames)
            ],
            "nis": {"frames": self.nis_frames, "mean": self.nis_sum / self.nis_frames} if self.nis_frames else None,
            "exposure": self._exposure(),
            "latency_us": self._latency(),
            "finished": self.finished,
        }

    def _exposure(self) -> dict[str, Any] | None:
        """In how many frames the exposure was judged, too bright and too dark, and the mean of the factor it needs."""
        if not self.exposure_frames:
            return None
        factor = round(math.exp(self.log_exposure_factor / self.exposure_frames), 3)
        counts = {"too_bright": self.too_bright, "too_dark": self.too_dark}
        return {"frames": self.exposure_frames, **counts, "factor": factor}

    def _latency(self) -> dict[str, int]:
        """Percentiles: the smallest latency that so many frames did not exceed; empty where there are none."""
        if not self.latency_us:
            return {}
        values = np.array(sorted(self.latency_us))
        below = np.cumsum([self.latency_us[int(value)] for value in values])
        quantiles = {"p50": 0.50, "p95": 0.95, "p99": 0.99, "max": 1.0}
        ranks = {name: min(int(np.ceil(q * below[-1])), int(below[-1])) for name, q in quantiles.items()}
        return {name: int(values[np.searchsorted(below, rank)]) for name, rank in ranks.items()}


def contradictions_in_words(counts: dict[str, Any], most: int = 3) -> list[str]:
    """A sentence for each thing in the files that a run's `counts` say was contradicted, those of most frames first."""
    found = counts.get("contradictions", [])
    more = [f"{len(found) - most} further contradictions are in run.json"] if len(found) > most else []
    return [f"{one['text']} ({one['file']}, {one['frames']} frames)" for one in found[:most]] + more


class Record:
    """A run folder, and run.json with the counts of what is in it; a crash leaves counts a second old at most."""

    def __init__(
        self, folder: RunFolder, identity: Mapping[str, Any], more: Callable[[], Mapping[str, Any]] = dict
    ) -> None:
        """Describe the run by its `identity`; `more` gives further counts."""
        self.summary = Summary()
        self._folder, self._identity, self._more = folder, identity, more
        self._describe()

    def add(self, fix: Fix, latency_us: int | None, *, t_ns: int | None, error: str = "") -> None:
        """Append one frame. Raises: OSError when it cannot be written."""
        self.summary.finished = False
        self._folder.add(fix, latency_us, t_ns=t_ns)
        self.summary.count(fix, latency_us, error)
        self.renew()

    def renew(self) -> None:
        """Write run.json again where the last time was a second ago."""
        if time.monotonic() - self._described_s >= _RENEWED_S:
            self._describe()

    def end(self, *, finished: bool) -> None:
        """Write run.json with all counts."""
        self.summary.finished = finished
        self._describe()

    def _describe(self) -> None:
        self._described_s = time.monotonic()
        self._folder.describe({**self._identity, "counts": self.summary.as_dict() | dict(self._more())})


class LiveRecord:
    """The record of a server as a sink, begun once; what a full disk did not take is missing as whole rows."""

    def __init__(self, record: Record) -> None:
        self._record = record

    def add(self, item: Item, fix: Fix, latency_us: int | None) -> None:
        """Append one frame."""
        self._record.add(fix, latency_us, t_ns=item.t_ns)

    def tick(self) -> None:
        """Keep run.json fresh when no frames come."""
        self._record.renew()

    def close(self) -> None:
        """Describe all that was written."""
        self._record.end(finished=True)


@dataclass(frozen=True, slots=True)
class Setup:
    """What identifies a run beside its source."""

    method: str
    cold: bool
    config: Config
    station: Path
    camera: Path
    reading: Mapping[str, Any] = field(default_factory=dict)  # options that decide about pictures and stamps


def run(
    source: Source,
    localizer: Method,
    folder: RunFolder,
    setup: Setup,
    *,
    on_fix: Callable[[Item, Fix], None] = lambda _item, _fix: None,
    size: tuple[int, int] | None = None,
) -> Summary:
    """Process all of a source and describe the run, also when it is interrupted.

    Pictures that are not of `size` (width, height) px are bad frames whose pixels stay unread.

    Raises: InputError when not one row could be used.
    """
    record, finished, feed = Record(folder, identity_of(source, setup)), False, AidingFeed(source.sensors())
    summary, stage = record.summary, _START
    try:
        for item in source.items(size):
            aid(localizer, feed, item)
            fix, latency_us, error = process(localizer, item, "search" if setup.cold else stage)
            stage = fix.stage
            record.add(fix, latency_us, t_ns=item.t_ns, error=error)
            on_fix(item, fix)
            del item  # the next picture is read into its room
        finished = True
    finally:
        record.end(finished=finished)
    if not summary.usable:
        raise InputError(summary.first_error or f"{source.path}: no frame in it")
    return summary


def aid(localizer: Method, feed: SensorFeed, item: Item) -> None:
    """Give a method that makes use of them what the vehicle's sensors have said until an item."""
    if isinstance(localizer, Aided):
        for value in feed.until(item.t_ns):
            localizer.aid(value)


def process(localizer: Method, item: Item, stage: Stage) -> tuple[Fix, int | None, str]:
    """Fix of one item, its latency in microseconds, and what was wrong with it; `stage` holds while a frame is lost."""
    if isinstance(item, Unusable):
        return _unusable(item.frame, item.t_ns or 0, stage, item.reason), None, item.text
    start = time.perf_counter_ns()
    try:
        fix = localizer.process(item) if isinstance(item, Frame) else localizer.process_detections(item)
    except FrameError as error:
        name = item.name if isinstance(item, Frame) else item.frame
        return _unusable(name, item.t_ns, stage, error.reason), None, str(error)
    error_text = (
        f"frame {fix.frame}: stamp {fix.t_ns} does not follow the one before" if fix.reason == "bad_stamp" else ""
    )
    return fix, (time.perf_counter_ns() - start) // 1000, error_text


def _unusable(frame: str, t_ns: int, stage: Stage, reason: str) -> Fix:
    return Fix(frame, t_ns, "none", stage, reason=reason)


def identity_of(source: Source, setup: Setup) -> dict[str, Any]:
    """What the run was made from and with; the station and the camera under the names their copies have."""
    inputs = {path.name: path for path in source.inputs}
    inputs |= {"station.yaml": setup.station, "camera.yaml": setup.camera}
    return {
        "lumidock": version("lumidock"),
        "method": setup.method,
        "cold": setup.cold,
        "source": {"kind": source.kind, "name": source.path.name},
        **identities(inputs),
        "reading": dict(setup.reading),
        "config": setup.config.model_dump(mode="json"),
    }

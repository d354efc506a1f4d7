"""A run: every item of a source through a localizer into a run folder."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
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
    nis: list[float] = field(default_factory=list)
    latency_us: list[int] = field(default_factory=list)
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
        if math.isfinite(fix.nis):
            self.nis.append(fix.nis)
        if latency_us is not None:
            self.latency_us.append(latency_us)

    def as_dict(self) -> dict[str, Any]:
        """For run.json; latency in microseconds, decoding excluded."""
        quantiles = {"p50": 50, "p95": 95, "p99": 99, "max": 100}
        latency = {name: int(np.percentile(self.latency_us, q)) for name, q in quantiles.items() if self.latency_us}
        return {
            "frames": self.frames,
            "usable": self.usable,
            "valid": self.valid,
            "guide": self.guide,
            "guide_only": self.guide_only,
            "status": dict(self.status),
            "valid_by_stage": {name: count for name, count in self.stage.items() if count},
            "reason": {name: count for name, count in self.reason.items() if count},
            "nis": {"frames": len(self.nis), "mean": sum(self.nis) / len(self.nis)} if self.nis else None,
            "latency_us": latency,
            "finished": self.finished,
        }


@dataclass(frozen=True, slots=True)
class Setup:
    """What identifies a run beside its source."""

    method: str
    cold: bool
    config: Config
    station: Path
    camera: Path


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
    summary, identity, feed = Summary(), _identity(source, setup), AidingFeed(source.sensors())
    folder.describe(identity | {"counts": summary.as_dict()})
    stage: Stage = "search"
    try:
        for item in source.items(size):
            aid(localizer, feed, item)
            fix, latency_us, error = process(localizer, item, "search" if setup.cold else stage)
            stage = fix.stage
            folder.add(fix, latency_us, t_ns=item.t_ns)
            summary.count(fix, latency_us, error)
            on_fix(item, fix)
            del item  # the next picture is read into its room
        summary.finished = True
    finally:
        folder.describe(identity | {"counts": summary.as_dict()})
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


def _identity(source: Source, setup: Setup) -> dict[str, Any]:
    """What the run was made from and with; the station and the camera under the names their copies have."""
    inputs = {path.name: path for path in source.inputs}
    inputs |= {"station.yaml": setup.station, "camera.yaml": setup.camera}
    return {
        "lumidock": version("lumidock"),
        "method": setup.method,
        "cold": setup.cold,
        "source": {"kind": source.kind, "name": source.path.name},
        **identities(inputs),
        "config": setup.config.model_dump(mode="json"),
    }

"""Running recordings: one in this process, or many over workers, each into a run folder of its own."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2

from lumidock.app.run import Setup, identity_of, run
from lumidock.cli.scratch import scratch_folder
from lumidock.cli.shared import (
    Calibration,
    calibration_of,
    copy,
    file_of,
    keep_camera,
    open_any,
    prepare_folder,
)
from lumidock.config import Config, load_config
from lumidock.datatypes import Fix
from lumidock.errors import InputError, LumidockError
from lumidock.methods import Method, localizer_of
from lumidock.station import Station, load_station
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.source import Item, Network, Reading, Source

Report = Callable[[int, int | None], None]


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The options of `run` beside source and target, as they were given."""

    station: str | None = None
    camera: str | None = None
    method: str = "lumidock"
    cold: bool = False
    topic: str | None = None
    info_topic: str | None = None
    bits: int = 16
    fps: float | None = None
    as_stored: bool = False
    delay_ms: float = 0.0
    camera_name: str | None = None
    trusted: bool = False
    config: Path | None = None

    def reading(self) -> Reading:
        """How the source is to be read."""
        more = {"as_stored": self.as_stored, "trusted": self.trusted, "follow_calibration": self.camera is None}
        return Reading(self.fps, self.topic, self.info_topic, self.bits, **more)

    def settings(self) -> Config:
        """The settings of the file that was given, or the defaults. Raises: InputError."""
        return load_config(self.config) if self.config else Config()

    def as_read(self) -> dict[str, Any]:
        """What of them decides about pictures and stamps, for run.json."""
        names = ("topic", "info_topic", "bits", "fps", "as_stored", "delay_ms", "camera_name", "trusted")
        return {name: value for name, value in asdict(self).items() if name in names}


@dataclass(frozen=True, slots=True)
class Recording:
    """An opened source with the files that belong to it."""

    source: Source
    station_file: Path
    station: Station
    calibration: Calibration
    config: Config
    options: RunOptions

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of it."""
        return (*self.source.notes, *self.calibration.warnings)

    def localizer(self) -> Method:
        """The method that was asked for. Raises: InputError for a dock that it cannot use."""
        options = self.options
        return localizer_of(options.method, self.station, self.calibration.camera, self.config, cold=options.cold)

    def setup(self, camera_file: Path) -> Setup:
        """What identifies a run of it beside its source, `camera_file` with the calibration as it is kept."""
        options, files = self.options, (self.config, self.station_file, camera_file)
        return Setup(options.method, options.cold, *files, options.as_read())


def open_recording(source: str, options: RunOptions, network: Network | None = None) -> Recording:
    """Open a source with its station and camera. Raises: InputError, one line."""
    reading, delay_ms, station = options.reading(), options.delay_ms, options.station
    opened = open_any(source, reading, delay_ms=delay_ms, station=station, network=network)
    station_file = file_of("station", options.station, opened.station, opened)
    dock = load_station(station_file)
    calibration = calibration_of(options.camera, opened, name=options.camera_name, trusted=options.trusted)
    return Recording(opened, station_file, dock, calibration, options.settings(), options)


def run_recording(
    recording: Recording,
    localizer: Method,
    out: Path,
    *,
    progress: Report = lambda _done, _total: None,
    let_interrupt: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Localize all frames of a recording into the folder `out`, which is there; returns the counts.

    Raises: InputError when no row could be used, or where another process is writing there.
    """
    dock, lens, done = recording.station, recording.calibration.camera, 0
    with RunFolder(out, dock.ids) as folder:
        copy(recording.station_file, out / "station.yaml")
        camera_file = keep_camera(recording.calibration, out / "camera.yaml")
        setup = recording.setup(camera_file)
        progress(0, recording.source.count)

        def on_fix(_item: Item, _fix: Fix) -> None:
            nonlocal done
            done += 1
            progress(done, recording.source.count)
            let_interrupt()

        size = lens.width, lens.height
        return run(recording.source, localizer, folder, setup, on_fix=on_fix, size=size).as_dict()


@dataclass(frozen=True, slots=True)
class Job:
    """One recording of many; with `force` a folder that holds another run is written anew."""

    source: str
    out: Path
    options: RunOptions
    force: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """The counts of a recording, or the error that ended it; `kept` where an earlier call had finished it."""

    counts: dict[str, Any] | None
    error: str = ""
    notes: tuple[str, ...] = ()
    kept: bool = False


def jobs_of(sources: list[str], out: Path, options: RunOptions, *, force: bool) -> dict[str, Job]:
    """A job for each recording, by the name of its run folder: the file's, with a number where it comes again."""
    jobs = dict[str, Job]()
    for source in sources:
        stem = Path(source).resolve().name.split(".")[0] or "recording"
        name, number = stem, 1
        while name in jobs:
            number += 1
            name = f"{stem}-{number}"
        jobs[name] = Job(source, out / name, options, force)
    return jobs


def run_job(job: Job) -> Outcome:
    """Run a recording, unless it was finished before; an error is told, and ends none of the others."""
    cv2.setNumThreads(1)
    notes: tuple[str, ...] = ()
    try:
        recording = open_recording(job.source, job.options)
        notes = recording.notes
        counts = _finished(recording, job)
        if counts is not None:
            return Outcome(counts, notes=notes, kept=True)
        localizer = recording.localizer()
        prepare_folder(job.out, force=True)
        return Outcome(run_recording(recording, localizer, job.out), notes=notes)
    except (LumidockError, OSError) as error:
        return Outcome(None, " ".join(str(error).split()), notes)


def _finished(recording: Recording, job: Job) -> dict[str, Any] | None:
    """The counts of an earlier call that finished the same run; None where it has to be done, or done again.

    Raises: InputError for a folder that holds anything else, unless `force`.
    """
    if not job.out.exists() or not any(job.out.iterdir()):
        return None
    try:
        described = json.loads((job.out / "run.json").read_text(encoding="utf-8"))
        with scratch_folder() as folder:
            camera_file = keep_camera(recording.calibration, folder / "camera.yaml")
            identity = json.loads(json.dumps(identity_of(recording.source, recording.setup(camera_file))))
        same = all(described.get(name) == value for name, value in identity.items())
        counts = dict(described["counts"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        same, counts = False, {}
    if same and counts.get("finished") and counts.get("usable"):
        return counts
    if not same and not job.force:
        raise InputError(f"{job.out}: holds something else than this run; give --force to replace it")
    return None

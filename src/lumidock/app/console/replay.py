"""A recording frame by frame: its pictures, its fixes, and the fixes of other methods and settings beside them."""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from lumidock.app.console.frame_view import Scene, frame_view, trust
from lumidock.app.console.jobs import Job, Jobs
from lumidock.app.console.limits import Choice
from lumidock.app.console.live import picture_of
from lumidock.app.console.stretch import pack, require_stretch, stretch_of, write_stretch
from lumidock.app.console.tuning import profile_text
from lumidock.app.console.wizards import Files
from lumidock.app.run import Setup, run
from lumidock.camera import save_camera
from lumidock.config import Config
from lumidock.datatypes import Fix, Frame, Unusable
from lumidock.errors import InputError, LumidockError
from lumidock.methods import Method, require_method
from lumidock.picture import developed
from lumidock.station import load_station
from lumidock.streams.replay import read_fixes
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.source import Item, Source

_ALARMS = ("calibration", "survey", "frozen", "bad_frame", "bad_stamp", "mirror", "inconsistent")
_MOST_VARIANTS = 12  # beside each other in memory; 1,000 frames of one are some 5 MB

Row = tuple[Fix, int | None]


@dataclass(slots=True)
class Variant:
    """The fixes of one method with its settings over the frames from `first` on."""

    number: int
    label: str
    method: str
    choice: Choice
    first: int = 0
    rows: list[Row] = field(default_factory=list)

    def at(self, index: int) -> Row | None:
        """The fix of a frame of the recording and its latency in microseconds."""
        k = index - self.first
        return self.rows[k] if 0 <= k < len(self.rows) else None

    def view(self) -> dict[str, Any]:
        """For the page: the trust in each frame as one letter, and where something is lost or alarming."""
        fixes = [fix for fix, _ in self.rows]
        return {
            "number": self.number,
            "label": self.label,
            "method": self.method,
            "first": self.first,
            "trust": "".join(trust(fix)[0] for fix in fixes),
            "events": [event | {"index": event["index"] + self.first} for event in events(fixes)],
        }


def events(fixes: Sequence[Fix]) -> list[dict[str, Any]]:
    """Frames in which the pose or the guide was lost, or a reason came up that asks for a person."""
    found, before = list[dict[str, Any]](), None
    for index, fix in enumerate(fixes):
        lost = before is not None and (
            (before.valid and not fix.valid) or (before.guide is not None and fix.guide is None and not fix.valid)
        )
        if lost:
            found.append({"index": index, "kind": "loss", "reason": fix.reason})
        elif fix.reason in _ALARMS and (before is None or before.reason != fix.reason):
            found.append({"index": index, "kind": "alarm", "reason": fix.reason})
        before = fix
    return found


@dataclass(frozen=True, slots=True)
class Recording:
    """What is replayed: a run that there is, or a source that is run now, or both.

    `station` and `camera` are the files, `options` the words with which the commands read the source as it is read
    here; `size` (width, height) px of its pictures.
    """

    scene: Scene
    station: Path
    camera: Path
    method: str
    config: Config
    source: Source | None
    run: Path | None
    options: tuple[str, ...] = ()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in px that the camera file says."""
        return self.scene.camera.width, self.scene.camera.height


class _StoppedError(LumidockError):
    """The console was closed while it read a recording."""


class Replay:
    """Reads a recording on a thread of its own; pictures go to a temporary file, fixes stay in memory."""

    def __init__(self, recording: Recording, jobs: Jobs, scratch: Path, localizer: Method | None = None) -> None:
        """`localizer` is for a recording without a run, whose kernels should be compiled by now."""
        self.recording, self.run_folder = recording, recording.run or scratch / "run"
        self.problem, self.ended = "", False
        self._jobs, self._scratch, self._localizer = jobs, scratch, localizer
        self._lock, self._halt, self._numbers = threading.Lock(), threading.Event(), count(1)
        files = Files(recording.station, recording.camera, scratch)
        base = Variant(0, f"as recorded: {recording.method}", recording.method, Choice(recording.config, files))
        self._variants, self._places = {0: base}, list[tuple[int, int]]()
        self._pictures = tempfile.TemporaryFile(dir=scratch)  # noqa: SIM115  # closed with the replay
        self._thread = threading.Thread(target=self._read, name="replay", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Stop reading."""
        self._halt.set()
        if self._thread.ident is not None:
            self._thread.join(5.0)
        self._pictures.close()

    def _read(self) -> None:
        try:
            if self.recording.run is not None:
                self._read_run(self.recording.run)
            else:
                self._run_source()
        except _StoppedError:
            pass
        except (LumidockError, OSError) as error:
            self.problem = " ".join(str(error).split())
        self.ended = True

    def _read_run(self, folder: Path) -> None:
        rows = [(fix, us) for fix, _, us in read_fixes(folder, self.recording.scene.station.ids)]
        with self._lock:
            self._variants[0].rows = rows
        if self.recording.source is not None:
            for item in self.recording.source.items(self.recording.size):
                self._keep_picture(item)

    def _run_source(self) -> None:
        source, localizer, it = self.recording.source, self._localizer, self.recording
        assert source is not None
        assert localizer is not None

        def on_fix(item: Item, fix: Fix) -> None:
            self._keep_picture(item)
            with self._lock:
                self._variants[0].rows.append((fix, None))

        setup = Setup(it.method, False, it.config, it.station, it.camera)
        with RunFolder(self.run_folder, it.scene.station.ids) as folder:
            run(source, localizer, folder, setup, on_fix=on_fix, size=it.size)
        rows = [
            (fix, us)
            for (fix, _), (_, _, us) in zip(
                self._variants[0].rows, read_fixes(self.run_folder, it.scene.station.ids), strict=True
            )
        ]
        with self._lock:
            self._variants[0].rows = rows

    def _keep_picture(self, item: Item) -> None:
        if self._halt.is_set():
            raise _StoppedError
        data = picture_of(developed(item)) if isinstance(item, Frame) else b""
        with self._lock:
            at = self._pictures.seek(0, 2)
            self._pictures.write(data)
            self._places.append((at, len(data)))

    def picture(self, index: int) -> bytes:
        """The JPEG of a frame; empty where it has none or has not been read yet."""
        with self._lock:
            if not 0 <= index < len(self._places) or self._halt.is_set():
                return b""
            at, length = self._places[index]
            self._pictures.seek(at)
            return self._pictures.read(length)

    def view(self) -> dict[str, Any]:
        """The state of the recording: stamps, trust and events of all variants, and how far it has been read."""
        with self._lock:
            rows = self._variants[0].rows
            first_ns = next((fix.t_ns for fix, _ in rows if fix.reason != "bad_stamp"), 0)
            source = self.recording.source
            return {
                "count": len(rows),
                "pictures": len(self._places),
                "total": source.count if source is not None else len(rows),
                "ended": self.ended,
                "problem": self.problem,
                "frames": [fix.frame for fix, _ in rows],
                "t_s": [_seconds(fix, first_ns) for fix, _ in rows],
                "positions": [_position(fix) for fix, _ in rows],
                "variants": [variant.view() for variant in self._variants.values()],
            }

    def frame(self, number: int, index: int) -> dict[str, Any] | None:
        """One frame of a variant; None where it has none."""
        with self._lock:
            row = self._variant(number).at(index)
            if row is None:
                return None
            fix, latency_us = row
            variant, scene = self._variants[number], self.recording.scene
            last_seen = self._last_seen(variant, index, fix.t_ns)
        if variant.choice.files.station != self.recording.station:
            scene = Scene(load_station(variant.choice.files.station), scene.camera)
        return frame_view(fix, scene, latency_us) | {"index": index, "last_seen_s": last_seen}

    def _last_seen(self, variant: Variant, index: int, now_ns: int) -> dict[str, float]:
        """Seconds since each light was last identified, up to this frame."""
        ids, found = self.recording.scene.station.ids, dict[str, float]()
        for k in range(index - variant.first, -1, -1):
            fix = variant.rows[k][0]
            for light in fix.match.light.tolist() if fix.match is not None else ():
                if light >= 0:
                    found.setdefault(ids[light], round((now_ns - fix.t_ns) * 1e-9, 3))
            if len(found) == len(ids):
                break
        return found

    def _variant(self, number: int) -> Variant:
        if number not in self._variants:
            raise InputError(f"no variant {number}")
        return self._variants[number]

    def rerun(self, method: str, choice: Choice, label: str, stretch: tuple[int, int] | None) -> Job:
        """Run the recording, or a stretch of it, with another method or other settings; the job gives the variant.

        A run whose frames are not at hand is repeated from its detections. Raises: InputError for a method that there
        is not, a stretch that is none, or too many variants.
        """
        require_method(method)
        if stretch is not None and self.recording.source is not None:
            require_stretch(*stretch)
        with self._lock:
            if len(self._variants) > _MOST_VARIANTS:
                raise InputError(f"{_MOST_VARIANTS} variants are shown already; open the console anew")
        return self._jobs.start(label, lambda job: self._rerun(job, method, choice, label, stretch))

    def _rerun(
        self, job: Job, method: str, choice: Choice, label: str, stretch: tuple[int, int] | None
    ) -> dict[str, Any]:
        number = next(self._numbers)
        folder = self._scratch / f"variant-{number}"
        folder.mkdir()
        self._run_command(job, folder, method, choice, stretch)
        ids = self.recording.scene.station.ids
        rows = [(fix, us) for fix, _, us in read_fixes(folder / "run", ids)]
        variant = Variant(number, label, method, choice, stretch[0] if stretch else 0, rows)
        with self._lock:
            self._variants[number] = variant
        return {"variant": number}

    def _run_command(
        self, job: Job, folder: Path, method: str, choice: Choice, stretch: tuple[int, int] | None
    ) -> None:
        """`lumidock run` over the source, or over a stretch of it that is written into `folder`."""
        it, options = self.recording, self.recording.options
        if it.source is not None and stretch is None:
            path = it.source.path
        else:
            path, options = folder / "sequence", ()
            self._write_stretch(stretch, path)
        settings = folder / "config.yaml"
        settings.write_text(profile_text(choice.config, "of a comparison"), encoding="utf-8")
        words = (
            "--station",
            choice.files.station,
            "--camera",
            choice.files.camera,
            "--method",
            method,
            "--config",
            settings,
        )
        job.command(["run", str(path), *map(str, words), *options, "--out", str(folder / "run"), "--json"])

    def _write_stretch(self, stretch: tuple[int, int] | None, folder: Path) -> None:
        """The frames of a stretch as a sequence folder, with what the vehicle's own sensors said."""
        write_stretch(self._items(stretch), folder)
        source = self.recording.source
        sensors = source.path / "aiding.csv" if source is not None else Path()
        if sensors.is_file():
            shutil.copyfile(sensors, folder / "aiding.csv")

    def _items(self, stretch: tuple[int, int] | None) -> Iterable[Item]:
        """The frames of a stretch, or where they are not at hand their detections."""
        it = self.recording
        if it.source is not None and stretch is not None:
            return stretch_of(it.source, *stretch, it.size)
        with self._lock:
            rows = list(self._variants[0].rows)
        first, last = stretch or (0, len(rows) - 1)
        return [_detections(fix) for fix, _ in rows[first : last + 1]]

    def bundle(self, number: int, stretch: tuple[int, int], bookmarks: list[int], notes: str) -> Job:
        """Pack a stretch with a variant's settings for a bug report; the job's result names the file."""
        require_stretch(*stretch)
        with self._lock:
            variant = self._variant(number)
        return self._jobs.start("bundle", lambda job: self._bundle(job, variant, stretch, bookmarks, notes))

    def _bundle(
        self, job: Job, variant: Variant, stretch: tuple[int, int], bookmarks: list[int], notes: str
    ) -> dict[str, Any]:
        folder = Path(tempfile.mkdtemp(prefix="bundle-", dir=self._scratch))
        content, it = folder / "content", self.recording
        self._write_stretch(stretch, content / "sequence")
        shutil.copyfile(variant.choice.files.station, content / "sequence" / "station.yaml")
        save_camera(it.scene.camera, content / "sequence" / "camera.yaml")
        with RunFolder(content / "run", it.scene.station.ids) as rows:
            for index in range(stretch[0], stretch[1] + 1):
                row = variant.at(index)
                if row is not None:
                    rows.add(*row, t_ns=row[0].t_ns)
            rows.describe({"method": variant.method, "config": variant.choice.config.model_dump(mode="json")})
        about = {"method": variant.method, "frames": list(stretch), "bookmarks": bookmarks, "notes": notes}
        pack(content, folder / "bundle.zip", profile_text(variant.choice.config, variant.label), about)
        del job
        return {"file": str(folder / "bundle.zip")}


def _seconds(fix: Fix, first_ns: int) -> float | None:
    return None if fix.reason == "bad_stamp" else round((fix.t_ns - first_ns) * 1e-9, 4)


def _detections(fix: Fix) -> Item:
    """What a run keeps of a frame: its detections, if it had any."""
    if fix.match is None:
        return Unusable(fix.frame, fix.t_ns or None, fix.reason, "")
    return fix.match.detections


def _position(fix: Fix) -> list[float] | None:
    return None if fix.T_dock_cam is None else [round(float(x), 3) for x in fix.T_dock_cam[:3, 3]]

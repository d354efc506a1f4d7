"""A run into other people's formats."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

from lumidock.camera import load_camera
from lumidock.datatypes import Fix, Frame, Unusable
from lumidock.errors import InputError, extra
from lumidock.station import load_station
from lumidock.streams.replay import read_fixes
from lumidock.streams.sinks import FILE_KINDS, Setting, open_file_sink
from lumidock.streams.sources import Item, Source
from lumidock.streams.vehicle import Vehicle

KINDS = (*FILE_KINDS, ".parquet")


def export(
    run: Path,
    target: Path,
    source: Source | None = None,
    vehicle: Vehicle | None = None,
    *,
    progress: Callable[[int, int | None], None] = lambda _done, _total: None,
) -> int:
    """Write the run folder `run` as `target`, with the pictures of the `source` it was made from; returns the frames.

    Raises: InputError, one line, for a folder that is no run, another source than the run's, an unknown ending, or a
    place where no file can be.
    """
    if target.suffix not in KINDS:
        raise InputError(f"{target}: not one of {', '.join(KINDS)}")
    if target.suffix == ".mp4" and source is None:
        raise InputError(f"{target}: a video needs the pictures; give --source")
    if target.is_dir() or not target.parent.is_dir():
        raise InputError(f"{target}: is a folder, or stands in none")
    begun = target.with_name(f".{target.stem}.begun{target.suffix}")  # a file that is there stays until all is written
    try:
        done = _write(run, begun, source, vehicle, progress)
        begun.replace(target)
    finally:
        begun.unlink(missing_ok=True)
    return done


def _write(
    run: Path, path: Path, source: Source | None, vehicle: Vehicle | None, progress: Callable[[int, int | None], None]
) -> int:
    if path.suffix == ".parquet":
        with extra("parquet"):
            from lumidock.streams.parquet import write_parquet
        return write_parquet(run, path)
    setting, done = Setting(load_station(run / "station.yaml"), load_camera(run / "camera.yaml"), vehicle), 0
    with closing(open_file_sink(path, setting)) as sink:
        for item, fix, latency_us in _frames(run, setting, source):
            sink.add(item, fix, latency_us)
            done += 1
            progress(done, source.count if source else None)
    return done


def _frames(run: Path, setting: Setting, source: Source | None) -> Iterator[tuple[Item, Fix, int | None]]:
    """Each frame of the source with its fix; without a source the frame is only its name and stamp."""
    rows = read_fixes(run, setting.station.ids)
    if source is None:
        for fix, t_ns, latency_us in rows:
            yield Unusable(fix.frame, t_ns, "", ""), fix, latency_us
        return
    for item, row in zip_longest(source.items(), rows):
        if item is None or row is None or _name(item) != row[0].frame or item.t_ns != row[1]:
            raise InputError(f"{source.path}: not what {run} was made from")
        fix = row[0] if row[1] is not None else replace(row[0], t_ns=0)
        yield item, fix, row[2]


def _name(item: Item) -> str:
    return item.name if isinstance(item, Frame) else item.frame

"""Where frames come from: sequence folders, image folders, videos; the kind is guessed from the path."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lumidock.datatypes import Array, Detections, Frame, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.streams.images import SUFFIXES, read_image

Item = Frame | Detections | Unusable
_VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".ts", ".wmv")
_STAMP = re.compile(r"[+-]?\d{1,18}")


@dataclass(frozen=True, slots=True)
class Source:
    """An opened source: `items()` iterates over its frames from the start; `count` is how many, if known.

    `camera` and `station` are files found beside the frames, `inputs` the files whose hashes identify the source.
    """

    path: Path
    kind: str
    items: Callable[[], Iterator[Item]]
    count: int | None = None
    camera: Path | None = None
    station: Path | None = None
    inputs: tuple[Path, ...] = ()


def open_source(path: Path, fps: float | None = None) -> Source:
    """Open a sequence folder, an image folder (needs `fps`) or a video file.

    Raises: InputError, one line, when there is nothing to read.
    """
    if path.is_dir():
        return _open_folder(path, fps)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.suffix.lower() in _VIDEO_SUFFIXES:
        return _open_video(path, fps)
    raise InputError(f"{path}: neither a folder nor a video ({', '.join(_VIDEO_SUFFIXES)})")


def _open_folder(path: Path, fps: float | None) -> Source:
    camera, station = (file if file.exists() else None for file in (path / "camera.yaml", path / "station.yaml"))
    stamps, detections = path / "timestamps.csv", path / "detections.csv"
    if stamps.exists():
        rows = _read_stamps(stamps)
        if not rows:
            raise InputError(f"{stamps}: no frames")
        if detections.exists():
            spots = _read_detections(detections)
            return Source(
                path,
                "detections",
                lambda: _detections(rows, spots),
                len(rows),
                camera,
                station,
                (stamps, detections),
            )
        return Source(path, "sequence", lambda: _sequence(path, rows), len(rows), camera, station, (stamps,))
    pictures = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    if not pictures:
        raise InputError(f"{path}: neither timestamps.csv nor any PNG or JPEG in it")
    if fps is None:
        raise InputError(f"{path}: an image folder has no time stamps; give --fps")
    return Source(path, "images", lambda: _pictures(pictures, fps), len(pictures), camera, station)


def _read_csv(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """Rows of a CSV file that has at least `columns`; a field that is missing in a row is empty."""
    try:
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            reader = csv.DictReader((line.replace("\0", "") for line in file), restval="")
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise InputError(f"{path}: no column {missing[0]}; wanted {','.join(columns)}")
            return list(reader)
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: {error}") from None


def _read_stamps(path: Path) -> list[dict[str, str]]:
    return _read_csv(path, ("frame", "file", "t_ns"))


def _stamp(text: str) -> int | None:
    return int(text) if _STAMP.fullmatch(text.strip()) else None


def _sequence(folder: Path, rows: list[dict[str, str]]) -> Iterator[Item]:
    for row in rows:
        name, t_ns = row["frame"], _stamp(row["t_ns"])
        if t_ns is None:
            yield Unusable(
                name,
                None,
                "bad_stamp",
                f"frame {name}: stamp {row['t_ns']!r} is not an integer of nanoseconds",
            )
            continue
        try:
            yield Frame(name, t_ns, read_image(_inside(folder / "frames", row["file"])))
        except FrameError as error:
            yield Unusable(name, t_ns, error.reason, str(error))


def _inside(folder: Path, name: str) -> Path:
    """A file named by a table, which must not lead out of its folder."""
    if not name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise FrameError("bad_frame", f"{folder}: file name {name!r} refused")
    return folder / name


def _read_detections(path: Path) -> dict[str, list[dict[str, str]]]:
    """Rows of a table of detections by frame."""
    spots: dict[str, list[dict[str, str]]] = {}
    for row in _read_csv(path, ("frame", "u_px", "v_px")):
        spots.setdefault(row["frame"], []).append(row)
    return spots


def _detections(rows: list[dict[str, str]], spots: dict[str, list[dict[str, str]]]) -> Iterator[Item]:
    for row in rows:
        name, t_ns = row["frame"], _stamp(row["t_ns"])
        if t_ns is None:
            yield Unusable(
                name,
                None,
                "bad_stamp",
                f"frame {name}: stamp {row['t_ns']!r} is not an integer of nanoseconds",
            )
            continue
        try:
            yield _frame_detections(name, t_ns, spots.get(name, []))
        except ValueError as error:
            yield Unusable(name, t_ns, "bad_frame", f"frame {name}: {error}")


def _frame_detections(name: str, t_ns: int, rows: list[dict[str, str]]) -> Detections:
    """Detections from their rows; only the centres are required. Raises: ValueError for a number that is none."""

    def column(key: str, default: float) -> Array:
        return np.array([float(row.get(key) or default) for row in rows], float)

    uv = np.stack([column("u_px", np.nan), column("v_px", np.nan)], axis=1)
    if not np.isfinite(uv).all():
        raise ValueError("a centre is not a finite number")
    nan = float("nan")
    return Detections(
        name,
        t_ns,
        uv,
        column("radius_px", nan),
        column("flux", nan),
        column("p_light", 1.0),
        column("p_rear", nan),
    )


def _pictures(files: list[Path], fps: float) -> Iterator[Item]:
    for number, file in enumerate(files):
        t_ns = round(number * 1e9 / fps)
        try:
            yield Frame(file.stem, t_ns, read_image(file))
        except FrameError as error:
            yield Unusable(file.stem, t_ns, error.reason, str(error))


def _open_video(path: Path, fps: float | None) -> Source:
    capture = cv2.VideoCapture(str(path))
    opened, count = capture.isOpened(), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    if not opened:
        raise InputError(f"{path}: not a video that can be decoded")
    return Source(path, "video", lambda: _video(path, fps), count if count > 0 else None, inputs=(path,))


def _video(path: Path, fps: float | None) -> Iterator[Item]:
    """Decoded frames with the container's own presentation times, unless `fps` overrides them."""
    capture = cv2.VideoCapture(str(path))
    try:
        number = 0
        while capture.grab():
            ms = capture.get(cv2.CAP_PROP_POS_MSEC)
            t_ns = round(number * 1e9 / fps) if fps else round(ms * 1e6)
            decoded, image = capture.retrieve()
            name = f"{number:06d}"
            if decoded:
                yield Frame(name, t_ns, np.asarray(image, np.uint8))
            else:
                yield Unusable(name, t_ns, "bad_frame", f"frame {name}: cannot be decoded")
            number += 1
    finally:
        capture.release()

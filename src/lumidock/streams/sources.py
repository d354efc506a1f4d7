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
from lumidock.streams.images import SUFFIXES, mono_if_gray, read_image

Item = Frame | Detections | Unusable
_VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".ts", ".wmv")
_INTEGER, _MAX_STAMP = re.compile(r"[+-]?[0-9]{1,19}"), 2**63 - 1
_FPS_RANGE = (1e-3, 1e6)
_VIDEO_TINT = 4  # grey levels; decoded gray is off by up to 3

Row = dict[str, str]


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
    if fps is not None and not _FPS_RANGE[0] <= fps <= _FPS_RANGE[1]:
        raise InputError(f"--fps {fps:g}: wanted a frame rate from {_FPS_RANGE[0]:g} to {_FPS_RANGE[1]:g}")
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
    pictures = sorted((file for file in path.iterdir() if file.suffix.lower() in SUFFIXES), key=_in_natural_order)
    if not pictures:
        raise InputError(f"{path}: neither timestamps.csv nor any PNG or JPEG in it")
    if fps is None:
        raise InputError(f"{path}: an image folder has no time stamps; give --fps")
    return Source(path, "images", lambda: _pictures(pictures, fps), len(pictures), camera, station)


def _read_csv(path: Path, columns: tuple[str, ...]) -> list[Row]:
    """Rows of a CSV file that has at least `columns`; a field that is missing in a row is empty."""
    try:
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            # zero bytes are the tail of a file that a power cut left; within a row they spoil their field, no more
            lines = (line.replace("\0", "\ufffd") for line in file if line.strip("\0\r\n"))
            reader = csv.DictReader(lines, restval="")
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise InputError(f"{path}: no column {missing[0]}; wanted {','.join(columns)}")
            return list(reader)
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None


def _read_stamps(path: Path) -> list[Row]:
    return _read_csv(path, ("frame", "file", "t_ns"))


def _stamp(text: str) -> int | None:
    """An integer of 64 bits, or None."""
    if not _INTEGER.fullmatch(text.strip()) or abs(int(text)) > _MAX_STAMP:
        return None
    return int(text)


def _in_order(rows: list[Row], read: Callable[[Row, int], Item]) -> Iterator[Item]:
    """An item for each row of timestamps.csv; `read` makes it from the row and its stamp."""
    for row in rows:
        name, t_ns = row["frame"], _stamp(row["t_ns"])
        if t_ns is None:
            text = f"frame {name}: stamp {row['t_ns'][:40]!r} is not an integer of nanoseconds"
            yield Unusable(name, None, "bad_stamp", text)
            continue
        try:
            yield read(row, t_ns)
        except FrameError as error:
            yield Unusable(name, t_ns, error.reason, str(error))


def _sequence(folder: Path, rows: list[Row]) -> Iterator[Item]:
    return _in_order(
        rows, lambda row, t_ns: Frame(row["frame"], t_ns, read_image(_inside(folder / "frames", row["file"])))
    )


def _inside(folder: Path, name: str) -> Path:
    """A file named by a table, which must not lead out of its folder."""
    if not name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise FrameError("bad_frame", f"{folder}: file name {name!r} refused")
    return folder / name


def _read_detections(path: Path) -> dict[str, list[Row]]:
    """Rows of a table of detections by frame."""
    spots: dict[str, list[Row]] = {}
    for row in _read_csv(path, ("frame", "u_px", "v_px")):
        spots.setdefault(row["frame"], []).append(row)
    return spots


def _detections(rows: list[Row], spots: dict[str, list[Row]]) -> Iterator[Item]:
    return _in_order(rows, lambda row, t_ns: _frame_detections(row["frame"], t_ns, spots.get(row["frame"], [])))


def _frame_detections(name: str, t_ns: int, rows: list[Row]) -> Detections:
    """Detections from their rows; only the centres are required. Raises: FrameError for a number that is none."""

    def column(key: str, default: float = np.nan) -> Array:
        return np.array([float(row.get(key) or default) for row in rows], float)

    try:
        uv = np.stack([column("u_px"), column("v_px")], axis=1)
        radius_px, flux = column("radius_px"), column("flux")
        p_light, p_rear = column("p_light", 1.0), column("p_rear")
    except ValueError as error:
        raise FrameError("bad_frame", f"frame {name}: {error}") from None
    if not np.isfinite(uv).all():
        raise FrameError("bad_frame", f"frame {name}: a centre is not a finite number")
    if not all(((p >= 0.0) & (p <= 1.0) | np.isnan(p)).all() for p in (p_light, p_rear)):
        raise FrameError("bad_frame", f"frame {name}: a probability outside 0 to 1")
    return Detections(name, t_ns, uv, radius_px, flux, p_light, p_rear)


def _in_natural_order(file: Path) -> list[str | int]:
    """Sorting key that puts picture 2 before picture 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", file.name)]


def _pictures(files: list[Path], fps: float) -> Iterator[Item]:
    for number, file in enumerate(files):
        t_ns = round(number * 1e9 / fps)
        try:
            yield Frame(file.stem, t_ns, read_image(file))
        except FrameError as error:
            yield Unusable(file.stem, t_ns, error.reason, str(error))


def _open_video(path: Path, fps: float | None) -> Source:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not capture.grab():
            raise InputError(f"{path}: not a video that can be decoded")
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        capture.release()
    return Source(path, "video", lambda: _video(path, fps), count if count > 0 else None, inputs=(path,))


def _video(path: Path, fps: float | None) -> Iterator[Item]:
    """Decoded frames with the container's own presentation times, unless `fps` overrides them."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        number = 0
        while capture.grab():
            ms = capture.get(cv2.CAP_PROP_POS_MSEC)
            t_ns = round(number * 1e9 / fps) if fps else round(ms * 1e6)
            decoded, image = capture.retrieve()
            name = f"{number:06d}"
            if decoded:
                yield Frame(name, t_ns, mono_if_gray(np.asarray(image, np.uint8), tint=_VIDEO_TINT))
            else:
                yield Unusable(name, t_ns, "bad_frame", f"frame {name}: cannot be decoded")
            number += 1
    finally:
        capture.release()

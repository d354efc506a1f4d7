"""Where frames come from: sequence folders, image folders, videos; the kind is guessed from the path."""

from __future__ import annotations

import csv
import re
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import ENCODINGS, Array, Attitude, Detections, Frame, Unusable
from lumidock.errors import FrameError, InputError, extra
from lumidock.geometry import rotation_from_quat_xyzw
from lumidock.streams.images import SUFFIXES, full_scale, read_image

Item = Frame | Detections | Unusable
_VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".ts", ".wmv")
BAG_SUFFIXES = (".mcap", ".db3", ".bag")
_INTEGER, _MAX_STAMP = re.compile(r"[+-]?[0-9]{1,19}"), 2**63 - 1
_FPS_RANGE = (1e-3, 1e6)
_ATTITUDE_COLUMNS = ("t_ns", "qx", "qy", "qz", "qw", "sigma_rad")
_ATTITUDE_REACH_NS = 100_000_000  # a row holds for frames this near to it
_MAX_ATTITUDE_NUMBER = 1e9  # of a quaternion that may have any length
_MIN_SIGMA_RAD = 1e-6  # no compass is better, and the inverse square of less overflows

Row = dict[str, str]


@dataclass(frozen=True, slots=True)
class Source:
    """An opened source: `items()` iterates over its frames from the start; `count` is how many, if known.

    `camera` and `station` are files found beside the frames, `calibration` the camera that a bag describes, `inputs`
    the files whose hashes identify the source. A `live` one has no end of its own, and is opened again when it is lost.
    """

    path: Path
    kind: str
    items: Callable[[], Iterator[Item]]
    count: int | None = None
    camera: Path | None = None
    station: Path | None = None
    inputs: tuple[Path, ...] = ()
    calibration: Camera | None = None
    live: bool = False


def open_source(
    path: Path, fps: float | None = None, *, topic: str | None = None, bits: int = 16, gray: bool = False
) -> Source:
    """Open a sequence folder, an image folder (needs `fps`), a video file or a bag of ROS 1 or ROS 2.

    `topic` chooses the pictures of a bag; 16-bit pixels have `bits` that count; `gray` says that colour is not needed.
    Raises: InputError, one line, when there is nothing to read.
    """
    if fps is not None and not _FPS_RANGE[0] <= fps <= _FPS_RANGE[1]:
        raise InputError(f"--fps {fps:g}: wanted a frame rate from {_FPS_RANGE[0]:g} to {_FPS_RANGE[1]:g}")
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.suffix.lower() in BAG_SUFFIXES or (path.is_dir() and _holds_a_bag(path)):
        with extra("bag"):
            from lumidock.streams.bag import open_bag
        return open_bag(path, topic, bits)
    if path.is_dir():
        return _open_folder(path, fps, bits)
    if path.suffix.lower() in _VIDEO_SUFFIXES:
        with extra("video"):
            from lumidock.streams.video import open_video
        return open_video(path, fps, gray)
    kinds = ", ".join((*_VIDEO_SUFFIXES, *BAG_SUFFIXES))
    raise InputError(f"{path}: neither a folder nor a video or bag ({kinds})")


def _holds_a_bag(folder: Path) -> bool:
    """Whether a recorder of bags made this folder; frames of a sequence come first."""
    if (folder / "timestamps.csv").exists():
        return False
    return any(file.suffix.lower() in BAG_SUFFIXES for file in folder.iterdir())


def _open_folder(path: Path, fps: float | None, bits: int) -> Source:
    camera, station = (file if file.exists() else None for file in (path / "camera.yaml", path / "station.yaml"))
    if (path / "timestamps.csv").exists():
        return _open_sequence(path, camera, station, bits)
    pictures = sorted((file for file in path.iterdir() if file.suffix.lower() in SUFFIXES), key=in_natural_order)
    if not pictures:
        raise InputError(f"{path}: neither timestamps.csv nor any PNG or JPEG in it")
    if fps is None:
        raise InputError(f"{path}: an image folder has no time stamps; give --fps")
    return Source(path, "images", lambda: _pictures(pictures, fps, bits), len(pictures), camera, station)


def _open_sequence(path: Path, camera: Path | None, station: Path | None, bits: int) -> Source:
    """A folder with timestamps.csv, and frames/ or detections.csv."""
    stamps, detections, attitude = path / "timestamps.csv", path / "detections.csv", path / "attitude.csv"
    rows = _read_csv(stamps, ("frame", "t_ns") if detections.exists() else ("frame", "file", "t_ns"))
    if not rows:
        raise InputError(f"{stamps}: no frames")
    attitudes = _read_attitudes(attitude) if attitude.exists() else _Attitudes([], np.empty((0, 5)))
    inputs = (stamps, attitude) if attitude.exists() else (stamps,)
    if detections.exists():
        by_frame, inputs = _read_detections(detections), (*inputs, detections)
        return Source(
            path, "detections", lambda: _detections(rows, by_frame, attitudes), len(rows), camera, station, inputs
        )
    return Source(path, "sequence", lambda: _sequence(path, rows, attitudes, bits), len(rows), camera, station, inputs)


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


def _stamp(text: str) -> int | None:
    """An integer of 64 bits, or None."""
    if not _INTEGER.fullmatch(text.strip()) or abs(int(text)) > _MAX_STAMP:
        return None
    return int(text)


@dataclass(frozen=True, slots=True, eq=False)
class _Attitudes:
    """Rows of attitude.csv by rising stamp: `t_ns` and `numbers` (N, 5) quat_xyzw, sigma rad, NaN in a broken row."""

    t_ns: list[int]
    numbers: Array

    def at(self, t_ns: int) -> Attitude | None:
        """The attitude of the row nearest to `t_ns`; None where that is broken or too far away."""
        after = bisect_left(self.t_ns, t_ns)
        around = range(max(after - 1, 0), min(after + 1, len(self.t_ns)))
        nearest = min(around, key=lambda i: abs(self.t_ns[i] - t_ns), default=None)
        if nearest is None or abs(self.t_ns[nearest] - t_ns) > _ATTITUDE_REACH_NS:
            return None
        *quat_xyzw, sigma_rad = self.numbers[nearest]
        if np.isnan(sigma_rad):
            return None
        return Attitude(rotation_from_quat_xyzw(np.array(quat_xyzw)), float(sigma_rad))


def _read_attitudes(path: Path) -> _Attitudes:
    """Attitudes by rising stamp; a row without a stamp is left out. Raises: InputError when no row is usable."""
    rows = [(t_ns, row) for row in _read_csv(path, _ATTITUDE_COLUMNS) if (t_ns := _stamp(row["t_ns"])) is not None]
    rows.sort(key=lambda pair: pair[0])
    numbers = np.array([_attitude_numbers(row) for _, row in rows]).reshape(-1, 5)
    if not np.isfinite(numbers).any():
        raise InputError(f"{path}: no usable row; wanted {','.join(_ATTITUDE_COLUMNS)}")
    return _Attitudes([t_ns for t_ns, _ in rows], numbers)


def _attitude_numbers(row: Row) -> Array:
    """Quaternion and sigma (5,) of a row; all NaN when they are no rotation with an error."""
    try:
        numbers = np.array([float(row[name]) for name in _ATTITUDE_COLUMNS[1:]])
        if not ((np.abs(numbers) < _MAX_ATTITUDE_NUMBER).all() and numbers[4] >= _MIN_SIGMA_RAD):
            raise ValueError("out of range")
        rotation_from_quat_xyzw(numbers[:4])
    except ValueError:
        return np.full(5, np.nan)
    return numbers


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


def _sequence(folder: Path, rows: list[Row], attitudes: _Attitudes, bits: int) -> Iterator[Item]:
    def read(row: Row, t_ns: int) -> Item:
        encoding = (row.get("encoding") or "").strip()
        mosaic = encoding if encoding.startswith("bayer") else ""
        if encoding and encoding not in ENCODINGS:
            raise FrameError(
                "bad_frame", f"frame {row['frame']}: encoding {encoding[:40]!r} is none of {', '.join(ENCODINGS)}"
            )
        image = full_scale(read_image(_inside(folder / "frames", row["file"]), mosaic), bits)
        return Frame(row["frame"], t_ns, image, attitudes.at(t_ns), mosaic)

    return _in_order(rows, read)


def _inside(folder: Path, name: str) -> Path:
    """A file named by a table, which must not lead out of its folder."""
    if not name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise FrameError("bad_frame", f"{folder}: file name {name!r} refused")
    return folder / name


def _read_detections(path: Path) -> dict[str, list[Row]]:
    """Rows of a table of detections by frame."""
    detections: dict[str, list[Row]] = {}
    for row in _read_csv(path, ("frame", "u_px", "v_px")):
        detections.setdefault(row["frame"], []).append(row)
    return detections


def _detections(rows: list[Row], detections: dict[str, list[Row]], attitudes: _Attitudes) -> Iterator[Item]:
    def read(row: Row, t_ns: int) -> Item:
        return _frame_detections(row["frame"], t_ns, detections.get(row["frame"], []), attitudes.at(t_ns))

    return _in_order(rows, read)


def _frame_detections(name: str, t_ns: int, rows: list[Row], attitude: Attitude | None) -> Detections:
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
    return Detections(name, t_ns, uv, radius_px, flux, p_light, p_rear, attitude=attitude)


def in_natural_order(file: Path) -> list[str | int]:
    """Sorting key that puts picture 2 before picture 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", file.name)]


def _pictures(files: list[Path], fps: float, bits: int) -> Iterator[Item]:
    for number, file in enumerate(files):
        t_ns = round(number * 1e9 / fps)
        try:
            yield Frame(file.stem, t_ns, full_scale(read_image(file), bits))
        except FrameError as error:
            yield Unusable(file.stem, t_ns, error.reason, str(error))

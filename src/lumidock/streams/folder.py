"""Sequence folders and image folders as sources."""

from __future__ import annotations

import csv
import glob
import re
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from lumidock.datatypes import ENCODINGS, AidingMeasurement, Array, Attitude, Detections, Frame, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.geometry import rotation_from_quat_xyzw
from lumidock.streams.clock import stamp_in_name
from lumidock.streams.images import SUFFIXES, full_scale, picture_header, read_image
from lumidock.streams.sensors import AIDING_COLUMNS, aiding_in
from lumidock.streams.source import Item, Reading, Size, Source, in_natural_order

_INTEGER, _MAX_STAMP = re.compile(r"[+-]?[0-9]{1,19}"), 2**63 - 1
_ATTITUDE_COLUMNS = ("t_ns", "qx", "qy", "qz", "qw", "sigma_rad")
_ATTITUDE_REACH_NS = 100_000_000  # a row holds for frames this near to it
_MAX_ATTITUDE_NUMBER = 1e9  # of a quaternion that may have any length
_MIN_SIGMA_RAD = 1e-6  # no compass is better, and the inverse square of less overflows
_EUROC_COLUMNS = ("#timestamp [ns]", "filename")
_TURNED = {3: "by 180 degrees", 6: "by 90 degrees clockwise", 8: "by 90 degrees counterclockwise"}

Row = dict[str, str]


def open_folder(path: Path, reading: Reading) -> Source:
    """A sequence folder, a camera's folder of EuRoC, or a folder of pictures with stamps in their names or with `fps`.

    Raises: InputError, one line, when there is nothing to read.
    """
    if (path / "timestamps.csv").exists():
        source = _open_sequence(path, reading)
    elif (path / "data.csv").exists() and (path / "data").is_dir():
        source = _open_euroc(path, reading)
    else:
        return _open_pictures(path, reading)
    if reading.fps is not None:
        return replace(source, notes=(*source.notes, f"--fps {reading.fps:g} is not used: the frames have stamps"))
    return source


def _beside(path: Path) -> tuple[Path | None, Path | None]:
    """The camera and the station file in a folder, where they are."""
    camera, station = (file if file.exists() else None for file in (path / "camera.yaml", path / "station.yaml"))
    return camera, station


def _open_sequence(path: Path, reading: Reading) -> Source:
    """A folder with timestamps.csv, and frames/ or detections.csv."""
    stamps, detections, attitude = path / "timestamps.csv", path / "detections.csv", path / "attitude.csv"
    rows = read_csv(stamps, ("frame", "t_ns") if detections.exists() else ("frame", "file", "t_ns"))
    if not rows:
        raise InputError(f"{stamps}: no frames")
    attitudes = _read_attitudes(attitude) if attitude.exists() else _Attitudes([], np.empty((0, 5)))
    inputs = tuple(file for file in (stamps, attitude, path / "aiding.csv") if file.exists())
    values = _read_aiding(path / "aiding.csv")
    if detections.exists():
        found, inputs = _read_detections(detections), (*inputs, detections)
        return Source(
            path,
            "detections",
            lambda _: _detections(rows, found, attitudes),
            len(rows),
            *_beside(path),
            inputs,
            sensors=lambda: values,
        )
    first = path / "frames" / rows[0]["file"]
    return Source(
        path,
        "sequence",
        lambda size: _sequence(path / "frames", rows, attitudes, reading, size),
        len(rows),
        *_beside(path),
        inputs,
        notes=_rotation_note(first, reading),
        sensors=lambda: values,
    )


def _read_aiding(path: Path) -> tuple[AidingMeasurement, ...]:
    """Values of the vehicle's sensors where a sequence has any."""
    return aiding_in(read_csv(path, AIDING_COLUMNS[:3]), path) if path.exists() else ()


def _open_euroc(path: Path, reading: Reading) -> Source:
    """The folder of one camera of a EuRoC data set: data/, data.csv and sensor.yaml."""
    table = path / "data.csv"
    columns = _EUROC_COLUMNS if _has_columns(table, _EUROC_COLUMNS) else ("#timestamp", "filename")
    rows = [
        {"frame": row[columns[0]].strip(), "file": row["filename"].strip(), "t_ns": row[columns[0]].strip()}
        for row in read_csv(table, columns)
    ]
    if not rows:
        raise InputError(f"{table}: no frames")
    camera, station = _beside(path)
    if camera is None and (path / "sensor.yaml").exists():
        camera = path / "sensor.yaml"
    attitudes = _Attitudes([], np.empty((0, 5)))
    return Source(
        path,
        "sequence",
        lambda size: _sequence(path / "data", rows, attitudes, reading, size),
        len(rows),
        camera=camera,
        station=station,
        inputs=(table,),
        notes=("read as a camera of EuRoC: stamps from data.csv",),
    )


def _has_columns(path: Path, columns: tuple[str, ...]) -> bool:
    try:
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            return set(columns) <= set(next(csv.reader(file), []))
    except (OSError, csv.Error):
        return False


def _open_pictures(path: Path, reading: Reading) -> Source:
    """A folder of pictures alone: stamps in their names, or as many a second as `fps` says."""
    files, left_out = _one_form_each(
        sorted((file for file in path.iterdir() if _is_picture(file)), key=in_natural_order)
    )
    if not files:
        if (path / "truth.csv").exists():
            raise InputError(f"{path}: a simulation that was interrupted; simulate it anew with `lumidock sim --force`")
        raise InputError(f"{path}: neither timestamps.csv nor any picture ({', '.join(SUFFIXES)}) in it{_hint(path)}")
    notes = list(_rotation_note(files[0], reading))
    if left_out:
        notes.append(
            f"{left_out} files are another form of a picture beside them, as {_example(path, files)}; left out"
        )
    t_ns = _stamps_in_names(files)
    if t_ns is not None:
        notes.append("stamps are those in the names of the pictures")
        if reading.fps is not None:
            notes.append(f"--fps {reading.fps:g} is not used: the names of the pictures are stamps")
    elif reading.fps is None:
        raise InputError(f"{path}: an image folder has no time stamps; give --fps")
    else:
        t_ns = [round(number * 1e9 / reading.fps) for number in range(len(files))]
    stamps = t_ns
    return Source(
        path,
        "images",
        lambda size: _pictures(files, stamps, reading, size),
        len(files),
        *_beside(path),
        notes=tuple(notes),
    )


def _is_picture(file: Path) -> bool:
    """Whether a file is a picture by its name; hidden ones, and what macOS leaves beside each file, are not."""
    return file.suffix.lower() in SUFFIXES and not file.name.startswith(".")


def _one_form_each(files: list[Path]) -> tuple[list[Path], int]:
    """One file for each name without its ending, the form that lost least, and how many others there were."""
    best: dict[str, Path] = {}
    for file in files:
        known = best.get(file.stem)
        if known is None or SUFFIXES.index(file.suffix.lower()) < SUFFIXES.index(known.suffix.lower()):
            best[file.stem] = file
    chosen = set(best.values())
    return [file for file in files if file in chosen], len(files) - len(chosen)


def _example(path: Path, files: list[Path]) -> str:
    for file in files:
        others = [
            other.name for other in path.glob(f"{glob.escape(file.stem)}.*") if other != file and _is_picture(other)
        ]
        if others:
            return f"{min(others)} of {file.name}"
    return files[0].name


def _hint(path: Path) -> str:
    """What the folder is instead, or which below it have pictures, as the end of a line that says that it has none."""
    if (path / "fixes.csv").exists():
        return "; it is the result of a run, which `lumidock report`, `eval` and `console` show"
    below = sorted(
        inner.name for inner in path.iterdir() if inner.is_dir() and any(_is_picture(file) for file in inner.iterdir())
    )
    return f"; there are some in {', '.join(below[:5])}" if below else ""


def _stamps_in_names(files: list[Path]) -> list[int] | None:
    """Stamps ns of files that are named by nothing else, in rising order of the same unit; None where they are not."""
    stamps = [stamp_in_name(file.stem) for file in files]
    found = [stamp for stamp in stamps if stamp is not None]
    if len(found) != len(files) or len({len(file.stem.partition(".")[0]) for file in files}) != 1:
        return None
    return found if all(a < b for a, b in pairwise(found)) else None


def _rotation_note(first: Path, reading: Reading) -> tuple[str, ...]:
    """What is to be known where the first picture says that it should be turned."""
    try:
        orientation = picture_header(first.read_bytes(), first).orientation if first.is_file() else 1
    except (OSError, FrameError):
        return ()
    if orientation == 1:
        return ()
    how = _TURNED.get(orientation, "and mirrored")
    if reading.as_stored:
        return (f"{first.name} says in its EXIF data that it should be turned {how}; left as stored",)
    return (f"pictures are turned {how} as their EXIF data say, which the calibration has to fit; or give --as-stored",)


def read_csv(path: Path, columns: tuple[str, ...]) -> list[Row]:
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
    rows = [(t_ns, row) for row in read_csv(path, _ATTITUDE_COLUMNS) if (t_ns := _stamp(row["t_ns"])) is not None]
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


def _sequence(
    folder: Path, rows: list[Row], attitudes: _Attitudes, reading: Reading, size: Size | None
) -> Iterator[Item]:
    def read(row: Row, t_ns: int) -> Item:
        encoding = (row.get("encoding") or "").strip()
        mosaic = encoding if encoding.startswith("bayer") else ""
        if encoding and encoding not in ENCODINGS:
            raise FrameError(
                "bad_frame", f"frame {row['frame']}: encoding {encoding[:40]!r} is none of {', '.join(ENCODINGS)}"
            )
        image = read_image(_inside(folder, row["file"]), mosaic, size=size, as_stored=reading.as_stored)
        image = full_scale(image, reading.bits)
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
    for row in read_csv(path, ("frame", "u_px", "v_px")):
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
    return Detections(name, t_ns, uv, radius_px=radius_px, flux=flux, p_light=p_light, p_rear=p_rear, attitude=attitude)


def _pictures(files: list[Path], stamps: list[int], reading: Reading, size: Size | None) -> Iterator[Item]:
    for file, t_ns in zip(files, stamps, strict=True):
        try:
            image = full_scale(read_image(file, size=size, as_stored=reading.as_stored), reading.bits)
            yield Frame(file.stem, t_ns, image)
        except FrameError as error:
            yield Unusable(file.stem, t_ns, error.reason, str(error))

"""A stretch of a recording as a sequence folder, which every command reads, and as a bundle for a bug report."""

from __future__ import annotations

import csv
import json
import platform
import zipfile
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

import cv2

from lumidock.datatypes import Detections, Frame, Unusable
from lumidock.errors import InputError
from lumidock.geometry import quat_xyzw_from_rotation
from lumidock.picture import in_color
from lumidock.streams.source import Item, Source

MOST_FRAMES = 400  # of a stretch: a camera's 5 megapixels as PNG are 3 MB each
_READ_ME = """\
A stretch of a recording for a report about lumidock {version}.

  sequence/     the frames with stamps, camera and station file: lumidock run sequence --config config.yaml --out RUN
  run/          the fixes that were shown, a row for each frame
  config.yaml   the settings that differ from the defaults
  about.json    versions, the machine, the method, and the bookmarked frames

Frames of a raw mosaic are written in their colours; every other picture is written pixel for pixel.
"""


def stretch_of(source: Source, first: int, last: int, size: tuple[int, int]) -> Iterator[Item]:
    """The items `first` to `last`, both included, of a source that is read from its start.

    Raises: InputError for a stretch that is none or too long.
    """
    require_stretch(first, last)
    return islice(source.items(size), first, last + 1)


def require_stretch(first: int, last: int) -> None:
    """Raises: InputError for a stretch that is none or too long."""
    if not 0 <= first <= last:
        raise InputError(f"frames {first} to {last}: wanted the first before the last")
    if last - first >= MOST_FRAMES:
        raise InputError(f"frames {first} to {last}: wanted at most {MOST_FRAMES}")


def write_stretch(items: Iterable[Item], folder: Path) -> int:
    """Write items as a sequence folder without camera and station file; returns how many they were."""
    pictures = folder / "frames"
    pictures.mkdir(parents=True, exist_ok=True)
    stamps: list[list[object]] = []
    attitudes: list[list[object]] = []
    detections: list[list[object]] = []
    bare = False
    for number, item in enumerate(items):
        name = item.name if isinstance(item, Frame) else item.frame
        file = f"{number:06d}.png"
        stamps.append([name, file, "" if item.t_ns is None else item.t_ns])
        if isinstance(item, Detections):
            bare = True
            detections += _detection_rows(item)
        elif isinstance(item, Frame):
            _write_picture(item, pictures / file)
        if not isinstance(item, Unusable) and item.attitude is not None:
            quat_xyzw = quat_xyzw_from_rotation(item.attitude.R_dock_cam)
            attitudes.append([item.t_ns, *quat_xyzw, item.attitude.sigma_rad])
    _write_table(folder / "timestamps.csv", ("frame", "file", "t_ns"), stamps)
    if attitudes:
        _write_table(folder / "attitude.csv", ("t_ns", "qx", "qy", "qz", "qw", "sigma_rad"), attitudes)
    if bare:
        columns = ("frame", "u_px", "v_px", "radius_px", "flux", "p_light", "p_rear")
        _write_table(folder / "detections.csv", columns, detections)
    return len(stamps)


def _detection_rows(d: Detections) -> Iterator[list[object]]:
    for k in range(len(d)):
        numbers = (*d.uv[k], d.radius_px[k], d.flux[k], d.p_light[k], d.p_rear[k])
        yield [d.frame, *("" if x != x else repr(float(x)) for x in numbers)]  # NaN differs from itself


def _write_picture(frame: Frame, path: Path) -> None:
    data = cv2.imencode(".png", in_color(frame), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    path.write_bytes(data.tobytes())


def _write_table(path: Path, columns: tuple[str, ...], rows: list[list[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def pack(folder: Path, target: Path, config_text: str, about: dict[str, Any]) -> None:
    """Zip `sequence/` and `run/` of a folder with the settings and what the reader has to know."""
    machine = {"lumidock": version("lumidock"), "python": platform.python_version(), "machine": platform.machine()}
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("README.txt", _READ_ME.format(version=version("lumidock")))
        archive.writestr("config.yaml", config_text)
        archive.writestr("about.json", json.dumps(machine | about, indent=1))
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                kind = zipfile.ZIP_STORED if path.suffix == ".png" else zipfile.ZIP_DEFLATED
                archive.write(path, path.relative_to(folder), kind)

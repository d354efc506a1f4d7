"""Detections of a recording, whatever it is: a run folder, bare detections, or pictures that are searched now."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Detections, Frame
from lumidock.errors import FrameError, InputError
from lumidock.localizer import Localizer
from lumidock.setup.observations import Progress
from lumidock.station import Station
from lumidock.streams.folder import read_csv

_NUMBERS = ("u_px", "v_px", "radius_px", "flux", "p_light", "p_rear")


def is_run(folder: Path) -> bool:
    """Whether a folder was written by `lumidock run`."""
    return (folder / "fixes.csv").is_file() and (folder / "lights.csv").is_file()


def detections_of_run(folder: Path) -> list[Detections]:
    """What a run detected, frame by frame; frames without a detection or a stamp are left out.

    Raises: InputError for tables that are none.
    """
    stamps = {row["frame"]: row["t_ns"] for row in read_csv(folder / "fixes.csv", ("frame", "t_ns"))}
    frames: dict[str, list[list[float]]] = {}
    for row in read_csv(folder / "lights.csv", ("frame", *_NUMBERS)):
        try:
            frames.setdefault(row["frame"], []).append([float(row[name] or "nan") for name in _NUMBERS])
        except ValueError as error:
            raise InputError(f"{folder / 'lights.csv'}: frame {row['frame']}: {error}") from None
    out = []
    for frame, numbers in frames.items():
        t_ns = stamps.get(frame, "")
        table = np.array(numbers)
        table = table[np.isfinite(table[:, :2]).all(axis=1)]
        if t_ns.lstrip("-").isdecimal() and len(table):
            sure = np.nan_to_num(table[:, 4], nan=1.0)
            out.append(
                Detections(
                    frame,
                    int(t_ns),
                    table[:, :2],
                    radius_px=table[:, 2],
                    flux=table[:, 3],
                    p_light=sure,
                    p_rear=table[:, 5],
                )
            )
    return out


def detections_of_items(
    items: Iterable[object], station: Station, camera: Camera, config: Config, progress: Progress | None = None
) -> list[Detections]:
    """Detections of a source's items; pictures are searched with the help of the track on the drawing's lights.

    Frames that cannot be read, or are of another size than the camera's, are left out.
    """
    localizer, out = Localizer(station, camera, config), []
    for done, item in enumerate(items, start=1):
        if isinstance(item, Detections):
            out.append(item)
        elif isinstance(item, Frame):
            try:
                match = localizer.process(item).match
            except FrameError:
                continue
            if match is not None and len(match.detections):
                out.append(match.detections)
        if progress is not None:
            progress(done, None)
    return out

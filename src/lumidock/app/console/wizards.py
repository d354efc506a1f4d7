"""Dock check, calibration in water and dock survey step by step; each ends in the command of the same purpose."""

from __future__ import annotations

import csv
import shutil
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from lumidock.app.console.jobs import Job, Jobs
from lumidock.app.console.tuning import require_target
from lumidock.camera import load_camera
from lumidock.datatypes import Frame
from lumidock.errors import InputError
from lumidock.picture import in_color
from lumidock.setup.boards import Board, find_board

_CELLS = (5, 4)  # of the coverage map, across and down, as `calib water` counts
_YAML = (".yaml", ".yml")
_MOST_TAKEN = 60  # views, as `calib water` uses


@dataclass(frozen=True, slots=True)
class Files:
    """The station and camera file in use, and a folder for what is not saved yet."""

    station: Path
    camera: Path
    scratch: Path


def check_dock(jobs: Jobs, files: Files) -> Job:
    """`lumidock station check`: what is in view, confused and measured."""
    words = ["station", "check", str(files.station), "--camera", str(files.camera), "--json"]
    return jobs.start("dock check", lambda job: job.command(words, codes=(0, 1)))


def board_of(asked: dict[str, Any]) -> Board:
    """The board that a request describes. Raises: InputError for one that there cannot be."""
    try:
        kind, columns, rows = str(asked["kind"]), int(asked["columns"]), int(asked["rows"])
        square_m, marker_m = float(asked["square_m"]), float(asked["marker_m"])
        dictionary = str(asked["dictionary"])
    except (KeyError, TypeError, ValueError):
        raise InputError("board: wanted kind, columns, rows, square_m, marker_m and dictionary") from None
    if kind not in ("charuco", "chessboard"):
        raise InputError(f"board: {kind}: wanted charuco or chessboard")
    if not dictionary.startswith("DICT_"):
        raise InputError(f"board: {dictionary}: wanted a name that begins with DICT_")
    return Board(cast("Any", kind), columns, rows, square_m, marker_m, dictionary)


class Calibration:
    """Views of a board that were taken from the live picture, and what `lumidock calib water` makes of them."""

    def __init__(self, files: Files) -> None:
        self._files, self._lock = files, threading.Lock()
        self._folder = files.scratch / "board"
        self._corners = list[np.ndarray]()
        self._size: tuple[int, int] | None = None

    def look(self, board: Board, frame: Frame, *, take: bool) -> dict[str, Any]:
        """The corners of the board in a frame, which is kept if `take`, and the coverage of those taken so far.

        Raises: InputError where a frame without the board, or of another size, is to be taken.
        """
        sighting = find_board(board, frame)
        size = (frame.image.shape[1], frame.image.shape[0])
        with self._lock:
            if take:
                if sighting is None:
                    raise InputError("the picture does not show enough of the board; nothing was taken")
                self._take(frame, sighting.uv, size)
            return {
                "frame": frame.name,
                "corners": [] if sighting is None else sighting.uv.round(2).tolist(),
                "width": size[0],
                "height": size[1],
                **self._coverage(),
            }

    def _take(self, frame: Frame, uv: np.ndarray, size: tuple[int, int]) -> None:
        if self._size not in (None, size):
            raise InputError(f"the picture is {size[0]}x{size[1]}, those before are {self._size}; begin anew")
        if len(self._corners) >= _MOST_TAKEN:
            raise InputError(f"{_MOST_TAKEN} views are taken; that is enough")
        self._folder.mkdir(exist_ok=True)
        data = cv2.imencode(".png", in_color(frame), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        (self._folder / f"{len(self._corners):04d}.png").write_bytes(data)
        self._size = size
        self._corners.append(uv)

    def _coverage(self) -> dict[str, Any]:
        """Corners in each cell of the picture, over all views taken."""
        if not self._corners or self._size is None:
            return {"taken": 0, "coverage": np.zeros(_CELLS[::-1], int).tolist()}
        uv = np.concatenate(self._corners)
        bins = [np.linspace(-0.5, side - 0.5, cells + 1) for side, cells in zip(self._size, _CELLS, strict=True)]
        counts = np.histogram2d(uv[:, 1], uv[:, 0], bins=[bins[1], bins[0]])[0]
        return {"taken": len(self._corners), "coverage": counts.astype(int).tolist()}

    def restart(self) -> None:
        """Forget the views that were taken."""
        with self._lock:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._corners, self._size = [], None

    def solve(self, jobs: Jobs, board: Board, model: str, source: str | None) -> Job:
        """`lumidock calib water` over the views taken, or over a recording `source`, beside the camera in use."""
        if model not in ("plumb_bob", "equidistant"):
            raise InputError(f"model {model}: wanted plumb_bob or equidistant")
        path = source or str(self._folder)
        if source is None and not self._folder.is_dir():
            raise InputError("no view was taken yet")
        words = ["calib", "water", path, "--board", board.kind, "--squares", f"{board.columns}x{board.rows}"]
        words += ["--square", str(board.square_m), "--marker", str(board.marker_m), "--dictionary", board.dictionary]
        out = self._files.scratch / "calibrated.yaml"
        words += ["--model", model, "--out", str(out), "--json"]

        def work(job: Job) -> dict[str, Any]:
            out.unlink(missing_ok=True)
            found: dict[str, Any] = job.command(words)
            old = load_camera(self._files.camera)
            return found | {"in_use": {"focal_px": old.focal_px.tolist(), "center_px": old.center_px.tolist()}}

        return jobs.start("calibration", work)


def survey_dock(jobs: Jobs, files: Files, run: Path, asked: dict[str, Any]) -> Job:
    """`lumidock survey` of a run, with labels, a taped distance and how far off the drawing may be."""
    words = ["survey", str(run), "--station", str(files.station), "--camera", str(files.camera)]
    if asked.get("off_m") is not None:
        words += ["--off", str(_number(asked, "off_m"))]
    if asked.get("tape_m") is not None:
        words += ["--distance", str(asked.get("tape_a")), str(asked.get("tape_b")), str(_number(asked, "tape_m"))]
    if asked.get("labels"):
        words += ["--labels", str(_write_labels(asked["labels"], files.scratch / "labels.csv"))]
    out = files.scratch / "surveyed.yaml"
    words += ["--out", str(out), "--json"]

    def work(job: Job) -> Any:  # noqa: ANN401  # whatever the command prints
        out.unlink(missing_ok=True)
        return job.command(words)

    return jobs.start("survey", work)


def _write_labels(labels: Any, path: Path) -> Path:  # noqa: ANN401  # what a request holds
    """The detections that the user confirmed or corrected, as `lumidock survey --labels` reads them."""
    try:
        rows = [(str(one["frame"]), float(one["uv"][0]), float(one["uv"][1]), str(one["light"])) for one in labels]
    except (IndexError, KeyError, TypeError, ValueError):
        raise InputError("labels: wanted a list of frame, uv and light") from None
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(("frame", "u_px", "v_px", "light"))
        table.writerows(rows)
    return path


def _number(asked: dict[str, Any], name: str) -> float:
    value = asked[name]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name}: wanted a number of metres")
    return float(value)


def save_result(files: Files, kind: str, target: Path, *, replace: bool) -> None:
    """Copy what a wizard found to where the user says. Raises: InputError where it found nothing, or for the file."""
    found = files.scratch / {"calibration": "calibrated.yaml", "survey": "surveyed.yaml"}.get(kind, "")
    if not found.is_file():
        raise InputError(f"no {kind} was made yet")
    require_target(target, _YAML, replace=replace)
    shutil.copyfile(found, target)

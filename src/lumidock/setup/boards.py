"""Calibration boards under water: their corners in pictures, by OpenCV's detectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from lumidock.datatypes import Array, Frame
from lumidock.errors import InputError
from lumidock.picture import developed

Kind = Literal["charuco", "chessboard"]
_LEAST_CORNERS = 8  # eight unknowns of a homography take four; twice that leaves something to check them by


@dataclass(frozen=True, slots=True)
class Board:
    """A flat board of `columns` by `rows` squares of `square_m`; a ChArUco board's markers measure `marker_m`.

    `dictionary` is OpenCV's name of the markers' dictionary. A chessboard is counted in squares too, as it is printed.
    """

    kind: Kind
    columns: int
    rows: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or self.square_m <= 0.0:
            raise InputError(f"a board of {self.columns}x{self.rows} squares of {self.square_m} m: too small")
        if self.kind == "charuco" and not 0.0 < self.marker_m < self.square_m:
            raise InputError("a ChArUco board needs markers smaller than its squares: give --marker")
        if not hasattr(cv2.aruco, self.dictionary):
            raise InputError(f"{self.dictionary}: OpenCV knows no such dictionary of markers")

    def corners_m(self) -> Array:
        """Inner corners (K, 3) m, row by row, in the board's plane z = 0."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1) * self.square_m


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A board in one picture: which corners (n,) of it, and their pixels `uv` (n, 2)."""

    frame: str
    corner: np.ndarray
    uv: Array


def find_board(board: Board, frame: Frame) -> Sighting | None:
    """The corners of the board that a picture shows; None where they are fewer than eight."""
    image = developed(frame)
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        drawn = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(gray)
        if ids is None or len(ids) < _LEAST_CORNERS:
            return None
        return Sighting(frame.name, np.asarray(ids).ravel(), np.asarray(corners, float).reshape(-1, 2))
    size = (board.columns - 1, board.rows - 1)
    found, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        return None
    uv = np.asarray(corners, float).reshape(-1, 2)
    return Sighting(frame.name, np.arange(len(uv)), uv)

"""Formats of analog and compressed video: interlaced fields, subsampled colour, renderer range of levels."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.sim.knobs import Output

_FOOT, _WHITE = 16.0, 235.0  # 8-bit levels of black and white in renderer range. Source: ITU-R BT.601-7, 2.5.3


def woven(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """An interlaced frame: even rows of the picture `first` (H, W[, 3]), odd rows of the later picture `second`."""
    frame = first.copy()
    frame[1::2] = second[1::2]
    return frame


def as_video(picture: np.ndarray, output: Output) -> np.ndarray:
    """Convert a picture (H, W[, 3]) to the video format of the knobs: one field, subsampled colour, renderer range."""
    if output.fields == "single":
        picture = picture[::2]
    if output.chroma == "half" and picture.ndim == 3:
        picture = _subsampled(picture)
    if output.levels == "16-235":
        picture = np.rint(_FOOT + picture * ((_WHITE - _FOOT) / 255.0)).astype(picture.dtype)
    return np.ascontiguousarray(picture)


def _subsampled(bgr: np.ndarray) -> np.ndarray:
    """Convert to 8-bit Y'CbCr with colour at half the width and height, and back. Source: ITU-R BT.601-7."""
    height, width = bgr.shape[:2]
    even = cv2.copyMakeBorder(bgr, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    back = cv2.cvtColor(cv2.cvtColor(even, cv2.COLOR_BGR2YUV_I420), cv2.COLOR_YUV2BGR_I420)
    return np.asarray(back[:height, :width])


def seen_by_field(camera: Camera, output: Output) -> Camera:
    """The calibration of the pictures as written: a single field has half of the rows, with pixels twice as high."""
    if output.fields != "single":
        return camera
    K = camera.K.copy()
    K[1] *= 0.5  # row 2 v of the whole picture is row v of the field
    return replace(camera, K=K, height=(camera.height + 1) // 2)

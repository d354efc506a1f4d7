"""What video adds to a picture: interlaced fields, subsampled colour, narrow levels."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.sim.knobs import Output

_FOOT, _WHITE = 16.0, 235.0  # levels of black and white in studio range. Source: ITU-R BT.601-7, 2.5.3


def woven(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """A frame of the even rows of one picture (H, W[, 3]) and the odd rows of a later one."""
    frame = first.copy()
    frame[1::2] = second[1::2]
    return frame


def as_video(picture: np.ndarray, output: Output) -> np.ndarray:
    """A picture (H, W[, 3]) as it comes out of a video: one field of it, colour of half the size, narrow levels."""
    if output.fields == "single":
        picture = picture[::2]
    if output.chroma == "half" and picture.ndim == 3:
        picture = _subsampled(picture)
    if output.levels == "16-235":
        picture = np.rint(_FOOT + picture * ((_WHITE - _FOOT) / 255.0)).astype(picture.dtype)
    return np.ascontiguousarray(picture)


def _subsampled(bgr: np.ndarray) -> np.ndarray:
    """Through 8-bit Y'CbCr in studio range with colour at half the width and height. Source: ITU-R BT.601-7."""
    height, width = bgr.shape[:2]
    even = cv2.copyMakeBorder(bgr, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    back = cv2.cvtColor(cv2.cvtColor(even, cv2.COLOR_BGR2YUV_I420), cv2.COLOR_YUV2BGR_I420)
    return np.asarray(back[:height, :width])


def seen_by_field(camera: Camera, output: Output) -> Camera:
    """The calibration of what is written: a single field has half of the rows, at twice the height of a pixel."""
    if output.fields != "single":
        return camera
    K = camera.K.copy()
    K[1] *= 0.5  # row 2 v of the frame is row v of the field
    return replace(camera, K=K, height=(camera.height + 1) // 2)

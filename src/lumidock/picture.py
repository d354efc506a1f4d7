"""Raw frames as pictures of 8 bits, for eyes and for whatever takes nothing else."""

from __future__ import annotations

import cv2
import numpy as np

from lumidock.datatypes import Frame, Image

_TO_BGR = {
    "rggb": cv2.COLOR_BayerRGGB2BGR,
    "bggr": cv2.COLOR_BayerBGGR2BGR,
    "gbrg": cv2.COLOR_BayerGBRG2BGR,
    "grbg": cv2.COLOR_BayerGRBG2BGR,
}
_LEAST_SIDE = 3  # pixels of a mosaic; in less some have no neighbours of every colour


def encoding_of(frame: Frame) -> str:
    """What a frame's pixels are, as ROS calls it: mono8, bgr16, bayer_rggb8, ..."""
    bits = 8 * frame.image.dtype.itemsize
    return frame.encoding or f"{'mono' if frame.image.ndim == 2 else 'bgr'}{bits}"


def in_color(frame: Frame) -> Image:
    """The picture of a frame at its own depth: (H, W) mono or (H, W, 3) BGR, a mosaic in its colours."""
    if not frame.encoding.startswith("bayer") or min(frame.image.shape) < _LEAST_SIDE:
        return frame.image
    return np.asarray(cv2.cvtColor(frame.image, _TO_BGR[frame.encoding.removeprefix("bayer_")[:4]]))


def developed(frame: Frame) -> Image:
    """The picture (H, W) mono8 or (H, W, 3) bgr8 of a frame: the upper 8 bits of 16, a mosaic in its colours."""
    image = in_color(frame)
    return image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)

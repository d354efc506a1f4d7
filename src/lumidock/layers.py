"""Front or rear: what the colour of each detection says of its layer."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from lumidock._kernels.detection.colors import colors, picture
from lumidock.config import LabelConfig
from lumidock.datatypes import SATURATED, Array, Detections, Frame, Indices

_OF_LETTER = {"b": 0, "g": 1, "r": 2}
_LINEAR = np.empty(0, np.float32)  # raw mosaics are


def label(frame: Frame, detections: Detections, config: LabelConfig, saturated: float = SATURATED) -> Detections:
    """Set `p_rear` by colour: blue is rear, white is front; NaN for a mono frame or where there is too little light.

    A core of the grey level `saturated`, of 255, is white whatever the lamp, so the ring around it is asked.
    """
    mosaic = frame.encoding.startswith("bayer")
    if not len(detections) or (frame.image.ndim == 2 and not mosaic):
        if np.isnan(detections.p_rear).all():
            return detections
        return replace(detections, p_rear=np.full(len(detections), np.nan))
    p_rear = np.empty(len(detections))
    decide = (config.blue_ratio, config.softness, config.min_signal, config.limit)
    colors(
        picture(frame),
        _order(frame.encoding),
        _LINEAR if mosaic or frame.image.dtype != np.uint8 else _linear(config.gamma),
        clipped=saturated,
        uv=detections.uv,
        radius=detections.radius_px,
        ring=config.ring,
        clear_px=config.clear_px,
        least_reach_px=config.min_reach_px,
        decide=decide,
        p_rear=p_rear,
    )
    return replace(detections, p_rear=p_rear)


@cache
def _linear(gamma: float) -> Array:
    """Light (256,) of a grey level, of 255."""
    return (255.0 * (np.arange(256) / 255.0) ** gamma).astype(np.float32)


@cache
def _order(encoding: str) -> Indices:
    """Colour of each channel, or of each corner of a mosaic's cell: B, G, R = 0, 1, 2."""
    letters = encoding.removeprefix("bayer_")[:4] if encoding.startswith("bayer") else "bgr"
    return np.array([_OF_LETTER[letter] for letter in letters], np.int64)

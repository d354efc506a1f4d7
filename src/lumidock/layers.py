"""Front or rear: what the colour of each detection says of its layer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumidock.config import LabelConfig
from lumidock.datatypes import Array, Detections, Frame, Image

_SATURATED = 250


def label(frame: Frame, detections: Detections, config: LabelConfig) -> Detections:
    """Set `p_rear` by colour: blue is rear, white is front; NaN for a mono frame or where there is too little light.

    A saturated core is white whatever the lamp, so the ring around it is asked.
    """
    unknown = np.full(len(detections), np.nan)
    if frame.image.ndim == 2:
        return replace(detections, p_rear=unknown)
    linear = (255.0 * (np.arange(256) / 255.0) ** config.gamma).astype(np.float32)
    spots = zip(detections.uv, detections.radius_px, strict=True)
    p_rear = [_rear_probability(frame.image, linear, uv, radius, config) for uv, radius in spots]
    return replace(detections, p_rear=np.array(p_rear, float))


def _rear_probability(image: Image, linear: Array, uv: Array, radius: float, config: LabelConfig) -> float:
    """P(rear) of the spot at `uv` (2,) px, NaN where its colour is not above the noise."""
    outer = config.ring[0] * radius + config.ring[1]
    window, distance = _window(image, uv, 2.0 * outer + 2.0)
    value = window.max(axis=2)
    ring = distance <= max(radius, config.min_reach_px)
    if (value[ring] >= _SATURATED).any():
        ring = (distance >= radius + config.clear_px) & (distance <= outer) & (value < _SATURATED)
    rim = distance > 1.5 * outer
    if not ring.any() or not rim.any():
        return float("nan")
    light, dark = linear[window[ring]], linear[window[rim]]
    signal = light.mean(axis=0) - np.median(dark, axis=0)
    sigma = dark.std(axis=0) / np.sqrt(len(light))
    return _from_signal(signal, sigma + 1e-3, config)


def _window(image: Image, uv: Array, reach: float) -> tuple[Image, Array]:
    """The part (V, U, 3) of an image within `reach` px of `uv`, and each pixel's distance (V, U) from there.

    Large parts are thinned out to about 32 samples a side.
    """
    u, v = float(uv[0]), float(uv[1])
    step = 1 + int(2.0 * reach) // 32
    rows = np.arange(max(int(v - reach), 0), min(int(v + reach) + 2, image.shape[0]), step)
    columns = np.arange(max(int(u - reach), 0), min(int(u + reach) + 2, image.shape[1]), step)
    return image[np.ix_(rows, columns)], np.hypot(columns[None] - u, rows[:, None] - v)


def _from_signal(signal: Array, sigma: Array, config: LabelConfig) -> float:
    """P(rear) from the linear light (3,) of B, G, R over the background and its error (3,)."""
    other = 1 + int(signal[2] > signal[1])
    if max(signal[0] / sigma[0], signal[other] / sigma[other]) < config.min_signal:
        return float("nan")
    blue, rest = (max(signal[i], sigma[i]) for i in (0, other))
    error = np.hypot(sigma[0] / blue, sigma[other] / rest)
    odds = (np.log(blue / rest) - np.log(config.blue_ratio)) / np.hypot(config.softness, error)
    return float(np.clip(1.0 / (1.0 + np.exp(-odds)), config.limit, 1.0 - config.limit))

"""Front or rear: discrimination of the two layers by colour and by radius, paper section 3.1.2."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from lumidock.config import LayersConfig
from lumidock.datatypes import Array, Detections, Frame, Image


def label_by_color(frame: Frame, detections: Detections, config: LayersConfig) -> Detections:
    """Set `p_rear` to the share of the surroundings of each detection that is blue; NaN for a mono frame.

    A saturated core is white whatever the lamp, so the ring around it is asked.
    """
    if frame.image.ndim == 2:
        return replace(detections, p_rear=np.full(len(detections), np.nan))
    shares = [
        _blue_share(frame.image, center, radius, config)
        for center, radius in zip(detections.uv, detections.radius_px, strict=True)
    ]
    return replace(detections, p_rear=np.array(shares, float))


def _blue_share(image: Image, center: Array, radius: float, config: LayersConfig) -> float:
    """Share of the pixels between 0.8 and 1.6 radii (small detections: within the radius) in the blue range of HSV."""
    small = radius < 3.0
    reach = max(radius, 1.0) if small else 1.6 * radius
    (u0, v0), (u1, v1) = np.floor(center - reach).astype(int), np.ceil(center + reach).astype(int) + 1
    u0, v0 = max(u0, 0), max(v0, 0)
    window = image[v0:v1, u0:u1]
    hue, saturation, value = cv2.split(cv2.cvtColor(window, cv2.COLOR_BGR2HSV))
    rows, columns = np.ogrid[v0 : v0 + window.shape[0], u0 : u0 + window.shape[1]]
    distance = np.hypot(columns - center[0], rows - center[1])
    ring = (distance <= reach) & ((distance >= 0.8 * radius) | small) & (value >= config.min_value)
    low, high = config.blue_hue
    blue = ring & (hue >= low) & (hue <= high) & (saturation >= config.min_saturation)
    return float(blue.sum() / max(int(ring.sum()), 1))


class LayerDiscriminator:
    """Splits the detections of a frame into front and rear, with the dual-cluster counter m as its memory."""

    def __init__(self, config: LayersConfig) -> None:
        self.config = config
        self.dual_frames = 0  # m

    def rear(self, detections: Detections) -> np.ndarray:
        """Whether each detection (N,) belongs to the rear layer."""
        blue = np.asarray(detections.p_rear > self.config.min_blue)
        by_color = {
            "color": True,
            "radius": False,
            "auto": bool(np.isfinite(detections.p_rear).any()),
            "color_or_radius": bool(blue.any()),
        }[self.config.method]
        return blue if by_color else self._by_radius(detections.radius_px)

    def _by_radius(self, radius_px: Array) -> np.ndarray:
        """Two clusters when they differ enough and each is big enough; else one, whose layer the history decides."""
        small = smaller_cluster(radius_px)
        counts = small.sum(), (~small).sum()
        if min(counts) >= self.config.min_cluster:
            u1, u2 = radius_px[small].mean(), radius_px[~small].mean()
            if u2 - u1 > self.config.radius_gap * u2:
                self.dual_frames += 1
                return small
        return np.full(len(radius_px), self.dual_frames > self.config.dual_frames)


def smaller_cluster(radius_px: Array) -> np.ndarray:
    """Members (N,) of the smaller-radius cluster of the split in two with the least variance: eq. (1), solved exactly.

    In one dimension the best clusters are contiguous, so every cut of the sorted radii is tried. NaN radii and fewer
    than two detections give no members.
    """
    members = np.zeros(len(radius_px), bool)
    if len(radius_px) < 2 or not np.isfinite(radius_px).all():
        return members
    order = np.argsort(radius_px, kind="stable")
    x = radius_px[order]
    costs = [x[:cut].var() * cut + x[cut:].var() * (len(x) - cut) for cut in range(1, len(x))]
    members[order[: int(np.argmin(costs)) + 1]] = True
    return members

"""The filter on distance and angle ratios over all ordered triples, paper section 3.2.2."""

from __future__ import annotations

import numpy as np

from lumidock.config import ConsistencyConfig
from lumidock.datatypes import Array


def consistent(lights_xy: Array, xy: Array, config: ConsistencyConfig) -> bool:
    """Whether associated detections `xy` (N, 2) agree with their lights `lights_xy` (N, 2) in every triple; N >= 3.

    The angle is taken between P_i P_j and P_j P_k as the vectors of eq. (10) have it; with both point sets treated
    alike it does not matter that the text calls it the angle at P_i.
    """
    ratio, angle = _triples(lights_xy)
    seen_ratio, seen_angle = _triples(xy)
    with np.errstate(divide="ignore", invalid="ignore"):  # coincident detections give NaN, and NaN is not consistent
        ratios_hold = np.abs(1.0 - ratio / seen_ratio) < config.ratio  # Eq. (9)
    angles_hold = np.abs(seen_angle - angle) < np.deg2rad(config.angle_deg)  # Eq. (10)
    return bool((ratios_hold & angles_hold).all())


def _triples(p: Array) -> tuple[Array, Array]:
    """d_jk / d_ij and the angle between P_i P_j and P_j P_k, for every ordered triple of different points."""
    n = len(p)
    i, j, k = (index.ravel() for index in np.meshgrid(*[np.arange(n)] * 3, indexing="ij"))
    different = (i != j) & (j != k) & (i != k)
    first, second = p[j] - p[i], p[k] - p[j]
    first, second = first[different], second[different]
    with np.errstate(divide="ignore", invalid="ignore"):
        d_ij, d_jk = np.hypot(*first.T), np.hypot(*second.T)
        cosine = (first * second).sum(axis=1) / (d_ij * d_jk)
        return d_jk / d_ij, np.arccos(np.clip(cosine, -1.0, 1.0))

"""Normalisation of both point sets before registration, paper section 3.2.1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import Array


@dataclass(frozen=True, slots=True, eq=False)
class Normalized:
    """Points (N, 2) with their mean taken away and scaled into [-1, 1]: original = mean + scale * points."""

    points: Array
    mean: Array
    scale: float


def normalize(xy: Array) -> Normalized:
    """Normalise points `xy` (N, 2): subtract the mean, divide by the largest coordinate."""
    mean = xy.mean(axis=0)
    centered = xy - mean
    scale = max(float(np.abs(centered).max()), 1e-12)
    return Normalized(centered / scale, mean, scale)

"""The Hungarian method alone: both sets normalised, then the cheapest one-to-one assignment, without any search.

Source: H. W. Kuhn, "The Hungarian Method for the Assignment Problem", 1955.
"""

from __future__ import annotations

import numpy as np

from lumidock._kernels.assignment import assign
from lumidock.baselines.view import LayerView
from lumidock.datatypes import Array, Indices

_FAR = 0.5  # of the rms radius of the lights; what is assigned farther away is spurious


def normalized(xy: Array) -> Array:
    """Points (N, 2) with zero mean and unit rms radius."""
    centered = xy - xy.mean(axis=0)
    return np.asarray(centered / max(float(np.sqrt((centered**2).sum(axis=1).mean())), 1e-12))


def associate(view: LayerView, _rng: np.random.Generator) -> Indices | None:
    """Light of each detection, -1 where the nearest one left is far away."""
    gap = np.linalg.norm(normalized(view.xy_up)[:, None] - normalized(view.p_dock[:, :2])[None], axis=2)
    light = assign(gap)
    return np.where(gap[np.arange(len(light)), light] <= _FAR, light, -1)

"""When a light is visible from a pose: its one definition in the estimator.

A light should be seen when it lies in the picture, some pixels from the edge (`lens.inside`), and its beam faces the
camera (`faces`). A light that only may be seen is missing at no cost.
"""

from __future__ import annotations

import math

from lumidock._kernels.compiling import part
from lumidock.datatypes import Array

EDGE_PX = 3.0  # px; nearer to the edge the blob is cut, and may be missing
_MIN_COSINE = 0.1  # of the beam's axis and the direction to the camera: 84 degrees; seen flatter, a lamp fades away


@part
def faces(R: Array, t: Array, p: Array, axis: Array) -> bool:
    """Whether a light at `p` (3,) of beam axis `axis` (3,) faces the camera at -R^T t; T_cam_dock is `R`, `t`."""
    norm, along = 0.0, 0.0
    for k in range(3):
        away = -(R[0, k] * t[0] + R[1, k] * t[1] + R[2, k] * t[2]) - p[k]
        norm += away * away
        along += away * axis[k]
    return along > _MIN_COSINE * math.sqrt(norm)

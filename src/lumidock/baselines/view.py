"""What a baseline is given: the detections and the lights of one layer in one frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Indices


@dataclass(frozen=True, slots=True, eq=False)
class LayerView:
    """N detections and the M lights that they may belong to.

    Lights: `p_dock` (M, 3) m, `axis` (M, 3) unit vectors along which they shine. Detections: undistorted image
    coordinates `xy` (N, 2), x right and y down, in units of the focal length, and unit vectors `ray_cam` (N, 3).
    `px` is the size of one pixel in these coordinates.
    """

    p_dock: Array
    axis: Array
    xy: Array
    ray_cam: Array
    px: float

    @property
    def xy_up(self) -> Array:
        """Image coordinates (N, 2) with y up, as the lights have it."""
        return self.xy * [1.0, -1.0]


# The light of each detection (N,), -1 for none; None where the method refuses to answer.
Associate = Callable[[LayerView, np.random.Generator], Indices | None]


def view_of(camera: Camera, p_dock: Array, axis: Array, uv: Array) -> LayerView:
    """The view of the detections `uv` (N, 2) px; non-finite where the lens model cannot place one."""
    ray = camera.unproject(uv)
    return LayerView(p_dock, axis, ray[:, :2] / ray[:, 2:], ray, 1.0 / float(np.mean(camera.focal_px)))

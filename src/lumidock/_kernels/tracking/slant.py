"""The slant of a plane of lights: how far it is turned from the line of sight, and the flattest view of it."""

from __future__ import annotations

import math

import numpy as np

from lumidock._kernels.compiling import part
from lumidock._kernels.lens import rotate_exp
from lumidock.datatypes import Array


@part
def tilt_of(R: Array, t: Array, plane: Array, turn_cov: Array, q: Array, axis: Array) -> tuple[float, float]:
    """Angle rad between a plane's normal and the line of sight to its point, and its sigma.

    Fills the point `q` (3,) in `cam` and the `axis` (3,) in `dock` that turns the normal onto the line of sight.
    """
    n, a = np.empty(3), np.empty(3)
    for i in range(3):
        q[i] = R[i, 0] * plane[0] + R[i, 1] * plane[1] + R[i, 2] * plane[2] + t[i]
        n[i] = R[i, 0] * plane[3] + R[i, 1] * plane[4] + R[i, 2] * plane[5]
    r = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    if n[0] * q[0] + n[1] * q[1] + n[2] * q[2] > 0.0:  # the normal toward the camera
        for i in range(3):
            n[i] *= -1.0
    a[0], a[1], a[2] = n[2] * q[1] - n[1] * q[2], n[0] * q[2] - n[2] * q[0], n[1] * q[0] - n[0] * q[1]
    sine = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    if sine < 1e-9 * r:
        a[0], a[1], a[2], sine = R[0, 0], R[1, 0], R[2, 0], 1e-12
    else:
        for i in range(3):
            a[i] /= sine
    tilt, var = math.atan2(sine, -(n[0] * q[0] + n[1] * q[1] + n[2] * q[2])), 0.0
    for i in range(3):
        axis[i] = R[0, i] * a[0] + R[1, i] * a[1] + R[2, i] * a[2]
    for i in range(3):
        for j in range(3):
            var += axis[i] * turn_cov[i, j] * axis[j]
    return tilt, math.sqrt(max(var, 0.0))


@part
def flatten(R: Array, t: Array, plane: Array, turn_cov: Array, Rf: Array, tf: Array) -> None:
    """Turn the plane about its point toward the camera, by three sigmas of its tilt at most."""
    q, d = np.empty(3), np.empty(3)
    tilt, sigma = tilt_of(R, t, plane, turn_cov, q, d)
    turn = min(tilt, 3.0 * sigma)
    for i in range(3):
        for k in range(3):
            Rf[i, k] = R[i, k]
    rotate_exp(Rf, turn * d[0], turn * d[1], turn * d[2])
    for i in range(3):
        tf[i] = q[i] - (Rf[i, 0] * plane[0] + Rf[i, 1] * plane[1] + Rf[i, 2] * plane[2])

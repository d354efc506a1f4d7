"""Protection levels from a pose's covariance: what a fix says, and how far it may be off."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.tracking.slant import tilt_of
from lumidock._kernels.tracking.track import FilterState
from lumidock.datatypes import Array

_TILT_SIGMAS = 2.5  # of a plane's tilt, for what its square does to the range


class SigmaFactors(NamedTuple):
    """Factors (3,) on sigma, in one, two and three dimensions, without a fault and with one light at fault.

    With `separate` every light may be at fault.
    """

    fault_free: Array
    one_fault: Array
    separate: bool


@part
def outputs(R: Array, t: Array) -> Array:
    """Jacobian (9, 6) of what a fix says for the pose's tangent.

    Error x, y, z, wx, wy, wz in dock axes as estimate minus truth, bearing x, bearing y rad, range m:
    T_cam_dock_true = T_cam_dock Exp(xi) makes t_est - t_true = rho + omega x t and R_est = Exp(omega) R_true.
    """
    C = np.zeros((9, 6))
    d = np.empty(3)
    for i in range(3):
        d[i] = -(R[0, i] * t[0] + R[1, i] * t[1] + R[2, i] * t[2])
        C[i, i] = C[3 + i, 3 + i] = 1.0
    C[0, 4], C[0, 5] = d[2], -d[1]
    C[1, 3], C[1, 5] = -d[2], d[0]
    C[2, 3], C[2, 4] = d[1], -d[0]
    x, y, z = t[0], t[1], t[2]
    xz, yz, r = max(x * x + z * z, 1e-12), max(y * y + z * z, 1e-12), max(math.sqrt(x * x + y * y + z * z), 1e-6)
    for k in range(3):
        C[6, k] = (z * R[0, k] - x * R[2, k]) / xz
        C[7, k] = (z * R[1, k] - y * R[2, k]) / yz
        C[8, k] = (x * R[0, k] + y * R[1, k] + z * R[2, k]) / r
    return C


@part
def _largest2(a: float, b: float, c: float) -> float:
    """Largest eigenvalue of [[a, b], [b, c]]."""
    return 0.5 * (a + c) + math.sqrt(0.25 * (a - c) * (a - c) + b * b)


@part
def _largest3(A: Array) -> float:
    """Largest eigenvalue of the symmetric rows and columns 3..5 of `A`, by the trigonometric formula."""
    m = (A[3, 3] + A[4, 4] + A[5, 5]) / 3.0
    a, b, c = A[3, 3] - m, A[4, 4] - m, A[5, 5] - m
    d, e, f = A[3, 4], A[3, 5], A[4, 5]
    p = math.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    if p <= 0.0:
        return m
    half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / (2.0 * p * p * p)
    return m + 2.0 * p * math.cos(math.acos(min(max(half, -1.0), 1.0)) / 3.0)


@entry
def protection_levels(
    state: FilterState, separations: Array, plane: Array, factors: SigmaFactors, cov: Array
) -> tuple[float, float, float, float, float]:
    """Protection levels: lateral m, axial m, angle rad, bearing rad, range m; `cov` (9, 9) of `outputs` is filled.

    `separations` (M, 18) as in `update`: what leaving each light out moves, and the variance that it adds. A tilted
    `plane` (6,) looks smaller by the square of its tilt: range and axial levels have room for what the tilt's spread
    can do to them.
    """
    R, t, P, k_free, k_fault = state.R, state.t, state.P, factors.fault_free, factors.one_fault
    C = outputs(R, t)
    for i in range(9):
        for j in range(i + 1):
            s = 0.0
            for k in range(6):
                for n in range(6):
                    s += C[i, k] * P[k, n] * C[j, n]
            cov[i, j] = cov[j, i] = s
    lateral, axial, angle = _largest2(cov[0, 0], cov[0, 1], cov[1, 1]), cov[2, 2], _largest3(cov)
    bearing, distance = _largest2(cov[6, 6], cov[6, 7], cov[7, 7]), cov[8, 8]
    pl0, pl1, pl2 = k_free[1] * math.sqrt(lateral), k_free[0] * math.sqrt(axial), k_free[2] * math.sqrt(angle)
    pl3, pl4 = k_free[1] * math.sqrt(bearing), k_free[0] * math.sqrt(distance)
    if factors.separate:
        for c in range(len(separations)):
            a = separations[c]
            if a[9] == 0.0 and a[10] == 0.0:
                continue
            pl0 = max(pl0, math.hypot(a[0], a[1]) + k_fault[1] * math.sqrt(lateral + a[9] + a[10]))
            pl1 = max(pl1, abs(a[2]) + k_fault[0] * math.sqrt(axial + a[11]))
            turn = math.sqrt(a[3] * a[3] + a[4] * a[4] + a[5] * a[5])
            pl2 = max(pl2, turn + k_fault[2] * math.sqrt(angle + a[12] + a[13] + a[14]))
            pl3 = max(pl3, math.hypot(a[6], a[7]) + k_fault[1] * math.sqrt(bearing + a[15] + a[16]))
            pl4 = max(pl4, abs(a[8]) + k_fault[0] * math.sqrt(distance + a[17]))
    if not math.isnan(plane[0]):
        q, axis = np.empty(3), np.empty(3)
        tilt, sigma = tilt_of(R, t, plane, P[3:6, 3:6].copy(), q, axis)
        far = tilt + _TILT_SIGMAS * sigma
        shrunk = 0.25 * (far * far - tilt * tilt) * math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
        pl1, pl4 = pl1 + shrunk, pl4 + shrunk
    return pl0, pl1, pl2, pl3, pl4

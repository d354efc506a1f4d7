"""Protection levels from a pose's covariance: what a fix says, and how far it may be off."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.tracking.bank import Bank, all_proven
from lumidock._kernels.tracking.slant import tilt_of
from lumidock._kernels.tracking.track import FilterState
from lumidock.datatypes import Array, Indices

_TILT_SHARE = 0.51  # of the factor on sigma, for what the square of a plane's tilt does to the range: 2.5 sigma at 1e-6


class SigmaFactors(NamedTuple):
    """Factors (3,) on sigma, in one, two and three dimensions.

    Without a fault; with one light at fault that geometry has not proven; with one that it has; and with a sensor of
    the vehicle at fault that the lights have not proven.
    """

    fault_free: Array
    unproven: Array
    proven: Array
    sensor: Array


class Groups(NamedTuple):
    """The subset that is blind to each light, `group` (M,), and the `planes` (L, 6) of the layers."""

    group: Indices
    planes: Array


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
    state: FilterState, plane: Array, bank: Bank, groups: Groups, factors: SigmaFactors, cov: Array
) -> tuple[float, float, float, float, float]:
    """Protection levels: lateral m, axial m, angle rad, bearing rad, range m; `cov` (9, 9) of `outputs` is filled.

    The filter's own, on the `plane` (6,) of its last lights, and that of every state of the `bank` that is blind to a
    light or, after those, to a sensor: how far it is off the filter and what it may be off itself.
    """
    C = outputs(state.R, state.t)
    level, other, apart, theirs = np.zeros(5), np.empty(5), np.zeros(9), np.empty((9, 9))
    nowhere, sensors = np.full(6, np.nan), groups.group.max() + 1
    _levels(state, C, state.P, plane, apart, factors.fault_free, cov, level)
    for s in range(len(bank.begun)):
        if bank.begun[s] == 0:
            continue
        for i in range(9):
            apart[i] = 0.0
            for k in range(6):
                apart[i] += C[i, k] * bank.offset[s, k]
        flat = groups.planes[bank.plane[s]] if bank.plane[s] >= 0 else nowhere
        k_fault = factors.proven if all_proven(bank, groups.group, s) else factors.unproven
        k_fault = factors.sensor if s >= sensors else k_fault
        _levels(state, C, bank.P[s], flat, apart, k_fault, theirs, other)
        for i in range(5):
            level[i] = max(level[i], other[i])
    return level[0], level[1], level[2], level[3], level[4]


@part
def _levels(
    state: FilterState, C: Array, P: Array, plane: Array, apart: Array, k: Array, cov: Array, level: Array
) -> None:
    """Fill the five levels (5,) of a pose of covariance `P` whose outputs `C` (9, 6) are `apart` (9,) off; and `cov`.

    A tilted plane looks smaller by the square of its tilt: range and axial levels have room for what the tilt's spread
    can do to them.
    """
    CP = np.zeros((9, 6))
    for i in range(9):
        for m in range(6):
            for n in range(6):
                CP[i, n] += C[i, m] * P[m, n]
    for i in range(9):
        for j in range(i + 1):
            s = 0.0
            for n in range(6):
                s += CP[i, n] * C[j, n]
            cov[i, j] = cov[j, i] = s
    lateral, bearing = _largest2(cov[0, 0], cov[0, 1], cov[1, 1]), _largest2(cov[6, 6], cov[6, 7], cov[7, 7])
    level[0] = math.hypot(apart[0], apart[1]) + k[1] * math.sqrt(lateral)
    level[1] = abs(apart[2]) + k[0] * math.sqrt(cov[2, 2])
    turned = math.sqrt(apart[3] ** 2 + apart[4] ** 2 + apart[5] ** 2)
    level[2] = turned + k[2] * math.sqrt(_largest3(cov))
    level[3] = math.hypot(apart[6], apart[7]) + k[1] * math.sqrt(bearing)
    level[4] = abs(apart[8]) + k[0] * math.sqrt(cov[8, 8])
    if not math.isnan(plane[0]):
        q, axis = np.empty(3), np.empty(3)
        tilt, sigma = tilt_of(state.R, state.t, plane, P[3:6, 3:6].copy(), q, axis)
        far = tilt + _TILT_SHARE * k[0] * sigma
        shrunk = 0.25 * (far * far - tilt * tilt) * math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
        level[1] += shrunk
        level[4] += shrunk

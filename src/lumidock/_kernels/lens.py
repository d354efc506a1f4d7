"""Projection of one point with its Jacobian, and small dense linear algebra, for the other kernels.

A lens is a flat array (20,): model (0 rational, 1 equidistant), fx, fy, cx, cy, fold, width, height, then k1, k2, k3,
k4, k5, k6, p1, p2 of the rational model or k1..k4 of the equidistant one, then of a flat port (`lumidock.port`) the
distance, the thickness and index of the glass, and the index of the water, which is 0 where there is no port.
"""

from __future__ import annotations

import math

import numpy as np

from lumidock._kernels.compiling import part
from lumidock.datatypes import Array, Indices

_STEEPEST = 20.0  # as `port.STEEPEST`
_PORT_STEPS, _PORT_TOLERANCE = 30, 1e-13  # of Newton's method, which needs three to six; relative

Projection = tuple[bool, float, float, float, float, float, float, float, float]


@part
def _unseen() -> Projection:
    return False, np.nan, np.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


@part
def project(lens: Array, x: float, y: float, z: float) -> Projection:
    """Whether the lens sees a point in `cam`, its pixel u, v, and the rows du/d(x, y, z), dv/d(x, y, z) px/m."""
    if lens[19] > 0.0:
        return _project_behind_port(lens, x, y, z)
    return _project_in_air(lens, x, y, z)


@part
def _project_behind_port(lens: Array, x: float, y: float, z: float) -> Projection:
    """`FlatPort.in_air`, and the lens in air behind it."""
    depth = z - lens[16] - lens[17]
    if not depth > 0.0:
        return _unseen()
    r = math.sqrt(x * x + y * y)
    a = r / (lens[16] + lens[17] / lens[18] + depth / lens[19])
    slope = 1.0
    for _ in range(_PORT_STEPS):
        water = lens[19] ** 2 + (lens[19] ** 2 - 1.0) * a * a
        glass = lens[18] ** 2 + (lens[18] ** 2 - 1.0) * a * a
        in_water, in_glass = 1.0 / math.sqrt(water), 1.0 / math.sqrt(glass)
        slope = lens[16] + lens[17] * lens[18] ** 2 * in_glass / glass + depth * lens[19] ** 2 * in_water / water
        step = (r - a * (lens[16] + lens[17] * in_glass + depth * in_water)) / slope
        if step <= _PORT_TOLERANCE * a:
            break
        a += step
        if a > _STEEPEST:
            return _unseen()
    scale, cx, cy = 1.0 / slope, 0.0, 0.0
    if r > 0.0:
        scale, cx, cy = a / r, x / r, y / r
    seen, u, v, uu, uv, _, vu, vv, _ = _project_in_air(lens, cx * a, cy * a, 1.0)
    radial = 1.0 / slope - scale
    xx, xy, yy = scale + radial * cx * cx, radial * cx * cy, scale + radial * cy * cy
    along = -a / math.sqrt(lens[19] ** 2 + (lens[19] ** 2 - 1.0) * a * a) / slope
    xz, yz = along * cx, along * cy
    return (
        seen,
        u,
        v,
        uu * xx + uv * xy,
        uu * xy + uv * yy,
        uu * xz + uv * yz,
        vu * xx + vv * xy,
        vu * xy + vv * yy,
        vu * xz + vv * yz,
    )


@part
def _project_in_air(lens: Array, x: float, y: float, z: float) -> Projection:
    if lens[0] == 1.0:
        return _project_equidistant(lens, x, y, z)
    if not z > 0.0:
        return _unseen()
    per_z = 1.0 / z
    a, b = x * per_z, y * per_z
    w = a * a + b * b
    if w >= lens[5] * lens[5]:
        return _unseen()
    k1, k2, k3, k4, k5, k6, p1, p2 = lens[8], lens[9], lens[10], lens[11], lens[12], lens[13], lens[14], lens[15]
    inverse = 1.0 / (1.0 + w * (k4 + w * (k5 + w * k6)))
    g = (1.0 + w * (k1 + w * (k2 + w * k3))) * inverse
    dg = (k1 + w * (2.0 * k2 + 3.0 * w * k3) - g * (k4 + w * (2.0 * k5 + 3.0 * w * k6))) * inverse
    u = a * g + 2.0 * p1 * a * b + p2 * (w + 2.0 * a * a)
    v = b * g + p1 * (w + 2.0 * b * b) + 2.0 * p2 * a * b
    fx, fy = lens[1] * per_z, lens[2] * per_z
    uu = (g + 2.0 * a * a * dg + 2.0 * p1 * b + 6.0 * p2 * a) * fx
    cross = 2.0 * a * b * dg + 2.0 * p1 * a + 2.0 * p2 * b
    uv, vu = cross * fx, cross * fy
    vv = (g + 2.0 * b * b * dg + 6.0 * p1 * b + 2.0 * p2 * a) * fy
    uz, vz = -(uu * a + uv * b), -(vu * a + vv * b)
    return True, u * lens[1] + lens[3], v * lens[2] + lens[4], uu, uv, uz, vu, vv, vz


@part
def _project_equidistant(lens: Array, x: float, y: float, z: float) -> Projection:
    r = math.sqrt(x * x + y * y)
    theta = math.atan2(r, z)
    if theta >= lens[5] or (r == 0.0 and z <= 0.0):
        return _unseen()
    k = lens[8:12]
    w = theta * theta
    bent = theta * (1.0 + w * (k[0] + w * (k[1] + w * (k[2] + w * k[3]))))
    slope = 1.0 + w * (3.0 * k[0] + w * (5.0 * k[1] + w * (7.0 * k[2] + w * 9.0 * k[3])))
    if r < 1e-9 * abs(z):
        scale = 1.0 / abs(z)
        return (
            True,
            x * scale * lens[1] + lens[3],
            y * scale * lens[2] + lens[4],
            scale * lens[1],
            0.0,
            0.0,
            0.0,
            (scale * lens[2]),
            0.0,
        )
    scale, norm2 = bent / r, r * r + z * z
    radial = slope * z / norm2 - scale
    a, b = x / r, y / r
    along = -slope * r / norm2
    uu, uv = (scale + radial * a * a) * lens[1], radial * a * b * lens[1]
    vu, vv = radial * a * b * lens[2], (scale + radial * b * b) * lens[2]
    u, v = x * scale * lens[1] + lens[3], y * scale * lens[2] + lens[4]
    return True, u, v, uu, uv, along * a * lens[1], vu, vv, along * b * lens[2]


@part
def inside(lens: Array, u: float, v: float, margin_px: float) -> bool:
    """Whether a pixel lies in the picture by at least `margin_px`."""
    edge = margin_px - 0.5
    return bool(edge < u < lens[6] - 0.5 - margin_px and edge < v < lens[7] - 0.5 - margin_px)


@part
def copy_to(source: Array | Indices, target: Array | Indices) -> None:
    """Overwrite `target` (n,), in place. Numba takes far longer to compile an assignment of slices."""
    for k in range(len(source)):
        target[k] = source[k]


@part
def factor(A: Array, n: int) -> float:
    """Cholesky factor of the leading (n, n) of `A`, in place in its lower triangle; log det A, NaN if not positive."""
    log_det = 0.0
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            if i == j:
                if not s > 0.0:
                    return np.nan
                A[i, i] = math.sqrt(s)
                log_det += math.log(s)
            else:
                A[i, j] = s / A[j, j]
    return log_det


@part
def solve_factored(L: Array, n: int, b: Array) -> None:
    """Solve L L^T x = b in place for the leading (n, n) of the factor `L`."""
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= L[k, i] * b[k]
        b[i] = s / L[i, i]


@part
def invert6(A: Array, L: Array, P: Array) -> float:
    """Inverse `P` (6, 6) of a symmetric `A` (6, 6), with `L` (6, 6) as work space; log det A, NaN if not positive."""
    for i in range(6):
        for j in range(i + 1):
            L[i, j] = A[i, j]
    log_det = factor(L, 6)
    if math.isnan(log_det):
        return log_det
    for j in range(6):  # columns of the inverse of L, into the lower triangle of P
        for i in range(j, 6):
            s = 1.0 if i == j else 0.0
            for k in range(j, i):
                s -= L[i, k] * P[k, j]
            P[i, j] = s / L[i, i]
    for i in range(6):  # P = L^-T L^-1, row by row from the top, which needs only rows below
        for j in range(i + 1):
            s = 0.0
            for k in range(i, 6):
                s += P[k, i] * P[k, j]
            L[i, j] = s
    for i in range(6):
        for j in range(i + 1):
            P[i, j] = P[j, i] = L[i, j]
    return log_det


@part
def rotate_exp(R: Array, wx: float, wy: float, wz: float) -> None:
    """R <- R Exp(w) in place. Source: Sola eq. (135)."""
    angle = math.sqrt(wx * wx + wy * wy + wz * wz)
    if angle < 1e-9:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    for i in range(3):
        r0, r1, r2 = R[i, 0], R[i, 1], R[i, 2]
        c0, c1, c2 = r1 * wz - r2 * wy, r2 * wx - r0 * wz, r0 * wy - r1 * wx  # row times [w]x
        d0, d1, d2 = c1 * wz - c2 * wy, c2 * wx - c0 * wz, c0 * wy - c1 * wx
        R[i, 0], R[i, 1], R[i, 2] = r0 + a * c0 + b * d0, r1 + a * c1 + b * d1, r2 + a * c2 + b * d2

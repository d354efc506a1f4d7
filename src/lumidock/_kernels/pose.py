"""Gauss-Newton for one pose from assigned detections and an attitude prior.

The pose is `R`, `t` of T_cam_dock, perturbed on the right: xi = [m, rad] in `dock` axes. A prior is `Rp` = R_dock_cam
expected, and `info` (3,) 1/rad^2 on the tilt toward cam x, toward cam y, and on the roll about the optical axis.
"""

from __future__ import annotations

import math

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.lens import factor, project, rotate_exp, solve_factored
from lumidock.datatypes import Array

SAME_TURN = 2e-3  # rad; closer solutions are one
_MAX_TURN = 0.5  # rad of one step


@part
def set_pose(R: Array, t: Array, R_new: Array, t_new: Array) -> None:
    """Overwrite a pose, in place."""
    for i in range(3):
        t[i] = t_new[i]
        for k in range(3):
            R[i, k] = R_new[i, k]


@part
def attitude_error(R: Array, Rp: Array, e: Array, J: Array) -> None:
    """Tilt and roll error `e` (3,) rad against the prior, and `J` (3, 3) for a right perturbation of T_cam_dock.

    Tilt is 2 tan(angle / 2) toward cam x and y (stereographic, so one formula serves up to a half turn), roll the
    twist about the optical axis.
    """
    D = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            D[i, j] = Rp[0, i] * R[j, 0] + Rp[1, i] * R[j, 1] + Rp[2, i] * R[j, 2]
    up = max(1.0 + D[2, 2], 1e-6)
    sine, cosine = D[1, 0] - D[0, 1], D[0, 0] + D[1, 1]
    e[0], e[1], e[2] = 2.0 * D[0, 2] / up, 2.0 * D[1, 2] / up, math.atan2(sine, cosine)
    norm = max(sine * sine + cosine * cosine, 1e-12)
    for k in range(3):  # a turn by omega_k in dock is a turn by w = -Rp^T omega of D, dD = [w]x D
        w0, w1, w2 = -Rp[k, 0], -Rp[k, 1], -Rp[k, 2]
        d02 = w1 * D[2, 2] - w2 * D[1, 2]
        d12 = w2 * D[0, 2] - w0 * D[2, 2]
        d22 = w0 * D[1, 2] - w1 * D[0, 2]
        ds = (w2 * D[0, 0] - w0 * D[2, 0]) - (w1 * D[2, 1] - w2 * D[1, 1])
        dc = (w1 * D[2, 0] - w2 * D[1, 0]) + (w2 * D[0, 1] - w0 * D[2, 1])
        J[0, k] = 2.0 * (d02 * up - D[0, 2] * d22) / (up * up)
        J[1, k] = 2.0 * (d12 * up - D[1, 2] * d22) / (up * up)
        J[2, k] = (cosine * ds - sine * dc) / norm


@part
def _add_prior(R: Array, Rp: Array, info: Array, H: Array, g: Array) -> float:
    e, J = np.empty(3), np.empty((3, 3))
    attitude_error(R, Rp, e, J)
    cost = 0.0
    for m in range(3):
        cost += info[m] * e[m] * e[m]
        for i in range(3):
            g[3 + i] -= info[m] * J[m, i] * e[m]
            for j in range(i + 1):
                H[3 + i, 3 + j] += info[m] * J[m, i] * J[m, j]
    return cost


@part
def light_row(lens: Array, R: Array, t: Array, p: Array, h: Array) -> bool:
    """Pixel and pose Jacobian of the light at `p` (3,), into `h` (14,): u, v, then the two rows of 6; False if unseen.

    Columns 0..2 of a row are also the Jacobian for a shift of the light in `dock`.
    """
    x = R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2] + t[0]
    y = R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2] + t[1]
    z = R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + t[2]
    seen, u, v, ux, uy, uz, vx, vy, vz = project(lens, x, y, z)
    if not seen:
        return False
    h[0], h[1] = u, v
    for k in range(3):
        h[2 + k] = ux * R[0, k] + uy * R[1, k] + uz * R[2, k]
        h[8 + k] = vx * R[0, k] + vy * R[1, k] + vz * R[2, k]
    for o in (2, 8):  # -a [p]x
        a0, a1, a2 = h[o], h[o + 1], h[o + 2]
        h[o + 3], h[o + 4], h[o + 5] = a2 * p[1] - a1 * p[2], a0 * p[2] - a2 * p[0], a1 * p[0] - a0 * p[1]
    return True


@part
def normal_equations(
    lens: Array, p: Array, uv: Array, var: Array, R: Array, t: Array, Rp: Array, info: Array, H: Array, g: Array
) -> float:
    """Fill the lower triangle of `H` (6, 6) and `g` (6,) at the pose; the cost, or NaN when a light is out of sight."""
    h = np.empty(14)
    for i in range(6):
        g[i] = 0.0
        for j in range(6):
            H[i, j] = 0.0
    cost = _add_prior(R, Rp, info, H, g)
    for m in range(len(p)):
        if not light_row(lens, R, t, p[m], h):
            return np.nan
        w = 1.0 / var[m]
        eu, ev = uv[m, 0] - h[0], uv[m, 1] - h[1]
        cost += w * (eu * eu + ev * ev)
        for i in range(6):
            g[i] += w * (h[2 + i] * eu + h[8 + i] * ev)
            for j in range(i + 1):
                H[i, j] += w * (h[2 + i] * h[2 + j] + h[8 + i] * h[8 + j])
    return cost


@part
def refine(
    lens: Array,
    p: Array,
    uv: Array,
    var: Array,
    R: Array,
    t: Array,
    Rp: Array,
    info: Array,
    steps: int,
    H: Array,
    L: Array,
) -> tuple[float, float]:
    """Move `R`, `t` to the most probable pose by at most `steps` Gauss-Newton steps, with damping where they fail.

    `p` (n, 3) m, `uv` (n, 2) and `var` (n,) px^2. Leaves the normal matrix in `H` (lower triangle). Returns the cost
    (sum of squares over variance, prior included) and log det H, both NaN on failure.
    """
    g, R0, t0 = np.empty(6), np.empty((3, 3)), np.empty(3)
    cost = normal_equations(lens, p, uv, var, R, t, Rp, info, H, g)
    damping = 0.0
    for _ in range(steps):
        if math.isnan(cost):
            return np.nan, np.nan
        for i in range(6):
            for j in range(i + 1):
                L[i, j] = H[i, j]
            L[i, i] *= 1.0 + damping
        if math.isnan(factor(L, 6)):
            return np.nan, np.nan
        step = g.copy()
        solve_factored(L, 6, step)
        gain = 0.0
        for i in range(6):
            gain += step[i] * g[i]
        set_pose(R0, t0, R, t)
        _move(R, t, step)
        new_cost = normal_equations(lens, p, uv, var, R, t, Rp, info, H, g)
        if not new_cost <= cost + 1e-9:
            set_pose(R, t, R0, t0)
            damping = max(10.0 * damping, 0.01)
            cost = normal_equations(lens, p, uv, var, R, t, Rp, info, H, g)
            continue
        cost, damping = new_cost, 0.1 * damping if damping > 1e-4 else 0.0
        if gain < 1e-3:
            break
    for i in range(6):
        for j in range(i + 1):
            L[i, j] = H[i, j]
    return cost, factor(L, 6)


@part
def _move(R: Array, t: Array, step: Array) -> None:
    """T <- T Exp(step) to first order in the translation; long turns are cut short."""
    turn = math.sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5])
    s = min(1.0, _MAX_TURN / turn) if turn > 0.0 else 1.0
    for i in range(3):
        t[i] += s * (R[i, 0] * step[0] + R[i, 1] * step[1] + R[i, 2] * step[2])
    rotate_exp(R, s * step[3], s * step[4], s * step[5])


@part
def turn(Ra: Array, Rb: Array) -> float:
    """Angle rad between two rotations, small or not."""
    s = 0.0
    for i in range(3):
        for j in range(3):
            s += (Ra[i, j] - Rb[i, j]) ** 2
    return math.sqrt(0.5 * s)


@part
def flip(p: Array, R: Array, t: Array) -> float:
    """Turn the pose into the other one that a plane seen from afar fits nearly as well; thickness of the set in m.

    Half a turn about the normal of the plane through `p` (n, 3), and half a turn about the line of sight to its
    centre. Source: D. Oberkampf, D. DeMenthon, L. Davis, 1996.
    """
    n, c, A = len(p), np.zeros(3), np.zeros((3, 3))
    for m in range(n):
        for i in range(3):
            c[i] += p[m, i] / n
    for m in range(n):
        for i in range(3):
            for j in range(3):
                A[i, j] += (p[m, i] - c[i]) * (p[m, j] - c[j]) / n
    normal = _least_axis(A)
    thickness = 0.0
    for i in range(3):
        for j in range(3):
            thickness += normal[i] * A[i, j] * normal[j]
    q, sight = np.empty(3), np.empty(3)
    for i in range(3):
        q[i] = R[i, 0] * c[0] + R[i, 1] * c[1] + R[i, 2] * c[2] + t[i]
    distance = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    for i in range(3):
        sight[i] = q[i] / distance
    B, C = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        along = R[i, 0] * normal[0] + R[i, 1] * normal[1] + R[i, 2] * normal[2]
        for j in range(3):
            B[i, j] = 2.0 * along * normal[j] - R[i, j]
    for i in range(3):
        for j in range(3):
            C[i, j] = -B[i, j]
            for k in range(3):
                C[i, j] += 2.0 * sight[i] * sight[k] * B[k, j]
    for i in range(3):
        for j in range(3):
            R[i, j] = C[i, j]
        t[i] = q[i] - (R[i, 0] * c[0] + R[i, 1] * c[1] + R[i, 2] * c[2])
    return math.sqrt(max(thickness, 0.0))


@entry
def flipped(p: Array, R: Array, t: Array) -> float:
    """`flip`, for Python to call."""
    return flip(p, R, t)


@part
def _least_axis(A: Array) -> Array:
    """Unit eigenvector (3,) of the smallest eigenvalue of a symmetric `A` (3, 3), by inverse iteration."""
    L, x = np.empty((3, 3)), np.empty(3)
    trace = A[0, 0] + A[1, 1] + A[2, 2]
    for i in range(3):
        for j in range(3):
            L[i, j] = A[i, j] + (1e-9 * trace + 1e-15 if i == j else 0.0)
    factor(L, 3)
    x[0], x[1], x[2] = 0.3, 0.2, 0.93
    for _ in range(8):
        solve_factored(L, 3, x)
        norm = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
        for i in range(3):
            x[i] /= norm
    return x

"""The filter's state: its prediction, a measured attitude, and where the lights are expected.

State of n = 18 + 3 M: 0-5 pose of T_cam_dock, right perturbation [m, rad] in `dock` axes; 6-11 twist of `cam` in `cam`
[m/s, rad/s]; 12-14 bias of the attitude sensor; 15-17 relative focal length and principal point px; then a shift of
each light in `dock`. With the pose perturbed on the dock's side, moving dock and lights together is unobservable in
the filter as it is in the world (M. Bloesch et al. 2013; A. Barrau, S. Bonnabel 2015 call such a choice invariant).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, fast_part, part
from lumidock._kernels.lens import inside, rotate_exp
from lumidock._kernels.pose import attitude_error, light_row, set_pose
from lumidock._kernels.visibility import EDGE_PX, faces
from lumidock.datatypes import Array

TWIST, BIAS, CALIBRATION, LIGHTS = 6, 12, 15, 18
_SURE_SIGMAS, _POSSIBLE_SIGMAS = (
    2.0,
    5.0,
)  # of a pixel: this far inside a light should be seen; this far outside it cannot
_WINDOW_SIGMAS = 4.0  # reach of a search window: one light in 16,000 lies outside in one axis


class Lights(NamedTuple):
    """M lights and the lens (16,) that sees them: positions `p` (M, 3) m, beam axes `axis` (M, 3), both in `dock`."""

    lens: Array
    p: Array
    axis: Array


class FilterState(NamedTuple):
    """Pose `R`, `t` of T_cam_dock, the other states `x` (n,), and the covariance `P` (n, n) of all."""

    R: Array
    t: Array
    x: Array
    P: Array


class PredictedMeasurements(NamedTuple):
    """Where every light is expected: `uv` (M, 2) px and `S` (2 M, 2 M) px^2, the joint covariance of all these pixels.

    `shown` (M,) is 0 out of the lens's sight, 1 where a light may be seen, 2 where it should be.
    """

    uv: Array
    S: Array
    shown: Array


@entry
def predict(state: FilterState, dt: float, q_lin: float, q_ang: float) -> None:
    """Move pose and covariance on by `dt` s at constant twist, in place.

    `q_lin` (m/s)^2/s and `q_ang` (rad/s)^2/s are the variances that each second adds to the twist.
    """
    R, t, x, P = state
    back = np.eye(3)
    vx, vy, vz, wx, wy, wz = x[TWIST], x[TWIST + 1], x[TWIST + 2], x[TWIST + 3], x[TWIST + 4], x[TWIST + 5]
    rotate_exp(back, -dt * wx, -dt * wy, -dt * wz)
    moved, turned = np.empty(3), np.empty((3, 3))
    half = 0.5 * dt * dt
    moved[0] = -dt * vx + half * (wy * vz - wz * vy)
    moved[1] = -dt * vy + half * (wz * vx - wx * vz)
    moved[2] = -dt * vz + half * (wx * vy - wy * vx)
    for i in range(3):
        for k in range(3):
            moved[i] += back[i, k] * t[k]
            turned[i, k] = back[i, 0] * R[0, k] + back[i, 1] * R[1, k] + back[i, 2] * R[2, k]
    set_pose(R, t, turned, moved)
    move_covariance(P, adjoint(R, t), dt, q_lin, q_ang)


@part
def move_covariance(P: Array, A: Array, dt: float, q_lin: float, q_ang: float) -> None:
    """Move the first rows of a covariance, `P` (12 or more, n), on by `dt` s, in place; `A` (6, 6) as in `adjoint`."""
    rows, n = P.shape
    AP = np.zeros((6, n))
    for i in range(6):
        for k in range(6):
            a = -dt * A[i, k]
            if a != 0.0:
                for j in range(n):
                    AP[i, j] += a * P[TWIST + k, j]
    for i in range(6):  # F P F^T with F = I + B, B = -dt A from twist to pose
        for j in range(n):
            P[i, j] += AP[i, j]
    for j in range(rows):
        for i in range(6):
            s = 0.0
            for k in range(6):
                s -= dt * A[i, k] * P[j, TWIST + k]
            P[j, i] += s
    for i in range(6):
        for k in range(6):
            q = q_lin if k < 3 else q_ang
            P[i, TWIST + k] -= A[i, k] * q * dt * dt / 2.0
            P[TWIST + k, i] = P[i, TWIST + k]
            for j in range(6):
                P[i, j] += A[i, k] * A[j, k] * q * dt * dt * dt / 3.0
    for k in range(6):
        P[TWIST + k, TWIST + k] += (q_lin if k < 3 else q_ang) * dt


@part
def adjoint(R: Array, t: Array) -> Array:
    """Adjoint (6, 6) of T_dock_cam from `R`, `t` of T_cam_dock."""
    A = np.zeros((6, 6))
    d = np.empty(3)
    for i in range(3):
        d[i] = -(R[0, i] * t[0] + R[1, i] * t[1] + R[2, i] * t[2])
        for j in range(3):
            A[i, j] = A[3 + i, 3 + j] = R[j, i]
    for j in range(3):
        a0, a1, a2 = R[j, 0], R[j, 1], R[j, 2]
        A[0, 3 + j], A[1, 3 + j], A[2, 3 + j] = d[1] * a2 - d[2] * a1, d[2] * a0 - d[0] * a2, d[0] * a1 - d[1] * a0
    return A


@entry
def attitude_update(state: FilterState, Rp: Array, var: Array, bias: bool) -> None:
    """Update by an attitude prior or measurement `Rp` (3, 3) = R_dock_cam of variance `var` (3,) rad^2, in place.

    With `bias` it is a sensor's, off by its bias and by as much again of noise, so that it never averages away.
    """
    R, t, x, P = state
    n = len(P)
    e, J, dx, g = np.empty(3), np.empty((3, 3)), np.zeros(n), np.empty(n)
    attitude_error(R, Rp, e, J)
    for k in range(3):
        residual = -e[k] - (x[BIAS + k] + dx[BIAS + k] if bias else 0.0)
        for j in range(3):
            residual -= J[k, j] * dx[3 + j]
        for i in range(n):
            g[i] = J[k, 0] * P[3, i] + J[k, 1] * P[4, i] + J[k, 2] * P[5, i] + (P[BIAS + k, i] if bias else 0.0)
        S = var[k] + J[k, 0] * g[3] + J[k, 1] * g[4] + J[k, 2] * g[5] + (g[BIAS + k] if bias else 0.0)
        for i in range(CALIBRATION):
            dx[i] += g[i] * residual / S
        for i in range(n):
            for j in range(n):
                if i < CALIBRATION or j < CALIBRATION:
                    P[i, j] -= g[i] * g[j] / S
    apply(R, t, x, dx)


@part
def apply(R: Array, t: Array, x: Array, dx: Array) -> None:
    """T_cam_dock <- T_cam_dock Exp(dx[:6]); the other states add."""
    move = np.empty(3)
    a, b, c = dx[3], dx[4], dx[5]
    # left Jacobian to second order: the translation of Exp
    move[0] = dx[0] + 0.5 * (b * dx[2] - c * dx[1])
    move[1] = dx[1] + 0.5 * (c * dx[0] - a * dx[2])
    move[2] = dx[2] + 0.5 * (a * dx[1] - b * dx[0])
    for i in range(3):
        t[i] += R[i, 0] * move[0] + R[i, 1] * move[1] + R[i, 2] * move[2]
    rotate_exp(R, a, b, c)
    for i in range(6, len(dx)):
        x[i] += dx[i]


@part
def difference(R0: Array, t0: Array, R: Array, t: Array, dx: Array) -> None:
    """The first six of `dx` that `apply` takes from one pose to the other."""
    D, move = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        move[i] = R0[0, i] * (t[0] - t0[0]) + R0[1, i] * (t[1] - t0[1]) + R0[2, i] * (t[2] - t0[2])
        for j in range(3):
            D[i, j] = R0[0, i] * R[0, j] + R0[1, i] * R[1, j] + R0[2, i] * R[2, j]
    a, b, c = 0.5 * (D[2, 1] - D[1, 2]), 0.5 * (D[0, 2] - D[2, 0]), 0.5 * (D[1, 0] - D[0, 1])
    sine = math.sqrt(a * a + b * b + c * c)
    angle = math.atan2(sine, 0.5 * (D[0, 0] + D[1, 1] + D[2, 2] - 1.0))
    s = angle / sine if sine > 1e-9 else 1.0
    a, b, c = s * a, s * b, s * c
    dx[0], dx[1], dx[2] = move[0], move[1], move[2]
    for _ in range(6):  # undo the half turn that `apply` adds
        x, y, z = dx[0], dx[1], dx[2]
        dx[0] = move[0] - 0.5 * (b * z - c * y)
        dx[1] = move[1] - 0.5 * (c * x - a * z)
        dx[2] = move[2] - 0.5 * (a * y - b * x)
    dx[3], dx[4], dx[5] = a, b, c


@part
def row(lights: Lights, state: FilterState, c: int, at: Array, h: Array, cal: Array) -> bool:
    """Pixel and Jacobians of light `c`, False if unseen: `h` (14,) as in `light_row`, `cal` (2,) with du/df, dv/df.

    `at` (3,) is work space.
    """
    x, lens, p = state.x, lights.lens, lights.p
    for k in range(3):
        at[k] = p[c, k] + x[LIGHTS + 3 * c + k]
    if not light_row(lens, state.R, state.t, at, h):
        return False
    scale = 1.0 + x[CALIBRATION]
    cal[0], cal[1] = h[0] - lens[3], h[1] - lens[4]
    h[0] = lens[3] + scale * cal[0] + x[CALIBRATION + 1]
    h[1] = lens[4] + scale * cal[1] + x[CALIBRATION + 2]
    for k in range(2, 14):
        h[k] *= scale
    return True


@fast_part
def gains(P: Array, h: Array, cal: Array, c: int, gu: Array, gv: Array) -> None:
    """P H^T of both rows of light `c`, (n,) each. One loop, in which every number of `P` is read once."""
    base = LIGHTS + 3 * c
    for i in range(len(P)):
        u = cal[0] * P[CALIBRATION, i] + P[CALIBRATION + 1, i]
        v = cal[1] * P[CALIBRATION, i] + P[CALIBRATION + 2, i]
        x, y, z = P[0, i] + P[base, i], P[1, i] + P[base + 1, i], P[2, i] + P[base + 2, i]
        a, b, d = P[3, i], P[4, i], P[5, i]
        gu[i] = u + h[2] * x + h[3] * y + h[4] * z + h[5] * a + h[6] * b + h[7] * d
        gv[i] = v + h[8] * x + h[9] * y + h[10] * z + h[11] * a + h[12] * b + h[13] * d


@part
def dot_row(g: Array, h: Array, cal: Array, axis: int, c: int) -> float:
    """H g for the row of u (`axis` 0) or v (1) of light `c`, as `row` has it."""
    base, o = LIGHTS + 3 * c, 2 + 6 * axis
    s = cal[axis] * g[CALIBRATION] + g[CALIBRATION + 1 + axis]
    for k in range(6):
        s += h[o + k] * g[k]
    for k in range(3):
        s += h[o + k] * g[base + k]
    return s


@entry
def predict_measurements(lights: Lights, state: FilterState, out: PredictedMeasurements) -> None:
    """Fill `out` with where every light is expected."""
    lens, p, axis = lights
    expected, S, shown = out
    m, n = len(p), len(state.P)
    at, rows, cals, gu, gv = np.empty(3), np.empty((m, 14)), np.empty((m, 2)), np.empty(n), np.empty(n)
    for c in range(m):
        shown[c] = 1.0 if row(lights, state, c, at, rows[c], cals[c]) else 0.0
    for c in range(m):
        if shown[c] == 0.0:
            continue
        expected[c, 0], expected[c, 1] = rows[c, 0], rows[c, 1]
        gains(state.P, rows[c], cals[c], c, gu, gv)
        for k in range(c + 1):
            if shown[k] == 0.0:
                continue
            S[2 * c, 2 * k] = dot_row(gu, rows[k], cals[k], 0, k)
            S[2 * c, 2 * k + 1] = dot_row(gu, rows[k], cals[k], 1, k)
            S[2 * c + 1, 2 * k] = dot_row(gv, rows[k], cals[k], 0, k)
            S[2 * c + 1, 2 * k + 1] = dot_row(gv, rows[k], cals[k], 1, k)
            for a in range(2):
                for b in range(2):
                    S[2 * k + b, 2 * c + a] = S[2 * c + a, 2 * k + b]
        margin = EDGE_PX + _SURE_SIGMAS * math.sqrt(max(S[2 * c, 2 * c], S[2 * c + 1, 2 * c + 1]))
        for k in range(3):
            at[k] = p[c, k] + state.x[LIGHTS + 3 * c + k]
        if faces(state.R, state.t, at, axis[c]) and inside(lens, rows[c, 0], rows[c, 1], margin):
            shown[c] = 2.0
    for c in range(m):  # far outside the picture there is nothing to look for
        if shown[c] == 1.0:
            margin = EDGE_PX + _POSSIBLE_SIGMAS * math.sqrt(max(S[2 * c, 2 * c], S[2 * c + 1, 2 * c + 1]))
            if not inside(lens, expected[c, 0], expected[c, 1], -margin):
                shown[c] = 0.0


@entry
def windows(predicted: PredictedMeasurements, margin_px: float, most_px: float, out: Array) -> int:
    """Write u, v and reach px, four sigmas and a margin, of each light that may be seen to `out` (M, 3); how many."""
    expected, S, shown = predicted
    count = 0
    for c in range(len(shown)):
        u, v, a, b = expected[c, 0], expected[c, 1], S[2 * c, 2 * c], S[2 * c + 1, 2 * c + 1]
        if shown[c] > 0.0 and math.isfinite(u) and math.isfinite(v) and not (math.isnan(a) or math.isnan(b)):
            reach = _WINDOW_SIGMAS * math.sqrt(max(a, b, 0.0)) + margin_px
            out[count, 0], out[count, 1], out[count, 2] = u, v, min(reach, most_px)
            count += 1
    return count

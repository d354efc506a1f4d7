"""The filter: prediction, association under the prediction, and the update by pixels.

State of n = 18 + 3 M: 0-5 pose of T_cam_dock, right perturbation [m, rad] in `dock` axes; 6-11 twist of `cam` in `cam`
[m/s, rad/s]; 12-14 bias of the attitude sensor; 15-17 relative focal length and principal point px; then a shift of
each light in `dock`. With the pose perturbed on the dock's side, moving dock and lights together is unobservable in
the filter as it is in the world (M. Bloesch et al. 2013; A. Barrau, S. Bonnabel 2015 call such a choice invariant).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lumidock._kernels.lens import factor, inside, rotate_exp
from lumidock._kernels.pose import attitude_error, light_row
from lumidock.datatypes import Array, Indices

TWIST, BIAS, CALIBRATION, LIGHTS = 6, 12, 15, 18
_LOG_2PI = math.log(2.0 * math.pi)
_LEAVES = 8
_MARGIN_PX, _SHINES = 3.0, 0.1
_SETTLED = 0.5  # sigmas; a pose that still moves by more in the last step is none
_TILT_SIGMAS = 2.5  # of a plane's tilt, for what its square does to the range


@njit(cache=True, error_model="numpy")
def predict(R: Array, t: Array, twist: Array, P: Array, dt: float, q_lin: float, q_ang: float) -> None:
    """Move pose and covariance on by `dt` s, in place; `q` are the variances that each second adds to the twist."""
    n = len(P)
    back = np.eye(3)
    rotate_exp(back, -dt * twist[3], -dt * twist[4], -dt * twist[5])
    moved, turned = np.empty(3), np.empty((3, 3))
    half = 0.5 * dt * dt
    wx, wy, wz = twist[3], twist[4], twist[5]
    moved[0] = -dt * twist[0] + half * (wy * twist[2] - wz * twist[1])
    moved[1] = -dt * twist[1] + half * (wz * twist[0] - wx * twist[2])
    moved[2] = -dt * twist[2] + half * (wx * twist[1] - wy * twist[0])
    for i in range(3):
        for k in range(3):
            moved[i] += back[i, k] * t[k]
            turned[i, k] = back[i, 0] * R[0, k] + back[i, 1] * R[1, k] + back[i, 2] * R[2, k]
    R[:], t[:] = turned, moved
    A = _adjoint(R, t)
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
    for j in range(n):
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


@njit(cache=True, error_model="numpy")
def _adjoint(R: Array, t: Array) -> Array:
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


@njit(cache=True, error_model="numpy")
def attitude_update(R: Array, t: Array, x: Array, P: Array, Rp: Array, var: Array, bias: bool) -> None:
    """Take in an attitude prior or measurement of variance `var` (3,) rad^2, in place; `x` (n,) the other states.

    With `bias` it is a sensor's, off by its bias and by as much again of noise, so that it never averages away.
    """
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
    _apply(R, t, x, dx, CALIBRATION)


@njit(cache=True, error_model="numpy")
def _apply(R: Array, t: Array, x: Array, dx: Array, n: int) -> None:
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
    for i in range(6, n):
        x[i] += dx[i]


@njit(cache=True, error_model="numpy")
def _difference(R0: Array, t0: Array, R: Array, t: Array, dx: Array) -> None:
    """The first six of `dx` that `_apply` takes from one pose to the other."""
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
    for _ in range(6):  # undo the half turn that `_apply` adds
        x, y, z = dx[0], dx[1], dx[2]
        dx[0] = move[0] - 0.5 * (b * z - c * y)
        dx[1] = move[1] - 0.5 * (c * x - a * z)
        dx[2] = move[2] - 0.5 * (a * y - b * x)
    dx[3], dx[4], dx[5] = a, b, c


@njit(cache=True, error_model="numpy")
def _row(lens: Array, R: Array, t: Array, x: Array, p: Array, c: int, at: Array, h: Array, cal: Array) -> bool:
    """Pixel, pose and calibration Jacobian of light `c`: `h` (14,) as in `light_row`, `cal` (4,) with du/df, dv/df."""
    for k in range(3):
        at[k] = p[c, k] + x[LIGHTS + 3 * c + k]
    if not light_row(lens, R, t, at, h):
        return False
    scale = 1.0 + x[CALIBRATION]
    cal[0], cal[1] = h[0] - lens[3], h[1] - lens[4]
    h[0] = lens[3] + scale * cal[0] + x[CALIBRATION + 1]
    h[1] = lens[4] + scale * cal[1] + x[CALIBRATION + 2]
    for k in range(2, 14):
        h[k] *= scale
    return True


@njit(cache=True, error_model="numpy")
def _gains(P: Array, h: Array, cal: Array, c: int, gu: Array, gv: Array) -> None:
    """P H^T of both rows of light `c`, (n,) each."""
    n = len(P)
    base = LIGHTS + 3 * c
    for i in range(n):
        gu[i] = cal[0] * P[CALIBRATION, i] + P[CALIBRATION + 1, i]
        gv[i] = cal[1] * P[CALIBRATION, i] + P[CALIBRATION + 2, i]
    for k in range(6):
        a, b = h[2 + k], h[8 + k]
        for i in range(n):
            gu[i] += a * P[k, i]
            gv[i] += b * P[k, i]
    for k in range(3):
        a, b = h[2 + k], h[8 + k]
        for i in range(n):
            gu[i] += a * P[base + k, i]
            gv[i] += b * P[base + k, i]


@njit(cache=True, error_model="numpy")
def _dot_row(g: Array, h: Array, o: int, df: float, dc: int, c: int) -> float:
    """H g for the row of `h` that starts at `o`; `dc` is the state of this row's principal point."""
    base = LIGHTS + 3 * c
    s = df * g[CALIBRATION] + g[dc]
    for k in range(6):
        s += h[o + k] * g[k]
    for k in range(3):
        s += h[o + k] * g[base + k]
    return s


@njit(cache=True, error_model="numpy")
def look(
    lens: Array, R: Array, t: Array, x: Array, P: Array, p: Array, axis: Array, expected: Array, S: Array, shown: Array
) -> None:
    """Where every light is expected: `expected` (M, 2) px and `S` (2 M, 2 M), the joint covariance of all these pixels.

    `shown` (M,) is 0 out of the lens's sight, 1 where a light may be seen, 2 where it should be.
    """
    m, n = len(p), len(P)
    at, h, cal = np.empty(3), np.empty(14), np.empty(4)
    rows, cals, gu, gv = np.empty((m, 14)), np.empty((m, 4)), np.empty(n), np.empty(n)
    for c in range(m):
        shown[c] = 1.0 if _row(lens, R, t, x, p, c, at, rows[c], cals[c]) else 0.0
    for c in range(m):
        if shown[c] == 0.0:
            continue
        h, cal = rows[c], cals[c]
        expected[c, 0], expected[c, 1] = h[0], h[1]
        _gains(P, h, cal, c, gu, gv)
        for k in range(c + 1):
            if shown[k] == 0.0:
                continue
            S[2 * c, 2 * k] = _dot_row(gu, rows[k], 2, cals[k, 0], CALIBRATION + 1, k)
            S[2 * c, 2 * k + 1] = _dot_row(gu, rows[k], 8, cals[k, 1], CALIBRATION + 2, k)
            S[2 * c + 1, 2 * k] = _dot_row(gv, rows[k], 2, cals[k, 0], CALIBRATION + 1, k)
            S[2 * c + 1, 2 * k + 1] = _dot_row(gv, rows[k], 8, cals[k, 1], CALIBRATION + 2, k)
            for a in range(2):
                for b in range(2):
                    S[2 * k + b, 2 * c + a] = S[2 * c + a, 2 * k + b]
        margin = _MARGIN_PX + 2.0 * math.sqrt(max(S[2 * c, 2 * c], S[2 * c + 1, 2 * c + 1]))
        norm, along = 0.0, 0.0
        for k in range(3):
            away = -(R[0, k] * t[0] + R[1, k] * t[1] + R[2, k] * t[2]) - p[c, k] - x[LIGHTS + 3 * c + k]
            norm += away * away
            along += away * axis[c, k]
        if along > _SHINES * math.sqrt(norm) and inside(lens, h[0], h[1], margin):
            shown[c] = 2.0
    for c in range(m):  # far outside the picture there is nothing to look for
        if shown[c] == 1.0:
            margin = _MARGIN_PX + 5.0 * math.sqrt(max(S[2 * c, 2 * c], S[2 * c + 1, 2 * c + 1]))
            if not inside(lens, expected[c, 0], expected[c, 1], -margin):
                shown[c] = 0.0


@njit(cache=True, error_model="numpy")
def associate(
    expected: Array,
    S: Array,
    shown: Array,
    layer: Indices,
    uv: Array,
    var: Array,
    like: Array,
    log_clutter: float,
    detect: float,
    gate: float,
    reach: float,
    max_nodes: int,
    names: Indices,
    costs: Array,
) -> int:
    """The most probable namings under the prediction, best first: `names` (K, M), `costs` (K,); returns how many.

    It returns -1 where the search would take more than `max_nodes`: a part of it says nothing.

    A depth-first search over the lights, each with the detections in its gate or none; every named light conditions
    those after it through their joint covariance (J. Neira, J. Tardos, 2001). Costs are -log evidence over "all
    clutter"; namings more than `reach` behind the best are not followed.
    """
    m, nd = len(expected), len(uv)
    cand, n_cand = np.empty((m, nd), np.int64), np.zeros(m, np.int64)
    for c in range(m):
        if shown[c] > 0.0:
            n_cand[c] = _in_gate(expected[c], S[2 * c : 2 * c + 2, 2 * c : 2 * c + 2], uv, var, gate, cand[c])
    miss = -math.log(1.0 - detect)
    order, depth, always = np.empty(m, np.int64), 0, 0.0
    for c in range(m):
        if n_cand[c] == 0 and shown[c] == 2.0:
            always += miss
    for want in range(1, nd + 1):
        for c in range(m):
            if n_cand[c] == want:
                order[depth] = c
                depth += 1
    least = np.zeros(m + 1)  # of the cost of all lights from a depth on
    narrow = np.empty((depth, 3))
    if depth:
        _narrowest(S, order[:depth], var.min(), narrow)
    for d in range(depth - 1, -1, -1):
        c = order[d]
        low = miss if shown[c] == 2.0 else 0.0
        for k in range(n_cand[c]):
            i = cand[c, k]
            det = (narrow[d, 0] + var[i]) * (narrow[d, 2] + var[i]) - narrow[d, 1] ** 2
            price = _LOG_2PI + 0.5 * math.log(max(det, var[i] * var[i]))
            low = min(low, price - math.log(detect) - like[i, layer[c]] + log_clutter)
        least[d] = least[d + 1] + low
    L, w = np.empty((2 * m, 2 * m)), np.empty(2 * m)
    chosen, count = np.empty(m, np.int64), np.zeros(m + 1, np.int64)
    cost, at = np.zeros(m + 1), np.zeros(m + 1, np.int64)
    name, taken = np.full(m, -1, np.int64), np.full(nd, -1, np.int64)
    found, d, nodes, best = 0, 0, 0, np.inf
    while d >= 0:
        if d == depth:
            best = min(best, cost[d])
            found = _keep(name, cost[d] + always, names, costs, found)
            d -= 1
            continue
        c = order[d]
        if name[c] >= 0:
            taken[name[c]] = -1
            name[c] = -1
        k = at[d]
        at[d] += 1
        nodes += 1
        if nodes > max_nodes:
            return -1
        if k > n_cand[c]:
            at[d] = 0
            d -= 1
            continue
        if k == n_cand[c]:  # not detected
            cost[d + 1] = cost[d] + (miss if shown[c] == 2.0 else 0.0)
            count[d + 1] = count[d]
        else:
            i = cand[c, k]
            if taken[i] >= 0:
                continue
            price = _name_one(expected, S, L, w, chosen, count[d], c, uv[i], var[i], gate)
            if math.isnan(price):
                continue
            cost[d + 1] = cost[d] + price + log_clutter - math.log(detect) - like[i, layer[c]]
            chosen[count[d]] = c
            count[d + 1] = count[d] + 1
            name[c], taken[i] = i, c
        if cost[d + 1] + least[d + 1] > best + reach:
            continue
        d += 1
        at[d] = 0
    return found


@njit(cache=True, error_model="numpy")
def _narrowest(S: Array, order: Indices, var: float, narrow: Array) -> None:
    """Covariance uu, uv, vv (D, 3) of each light's pixel when all before it in `order` (D,) are named.

    With fewer of them named it is wider: what it costs to name a light is never less.
    """
    L = np.empty((2 * len(order), 2 * len(order)))
    for k in range(len(order)):
        for r in range(2 * k, 2 * k + 2):
            row = 2 * order[k] + r % 2
            for j in range(r + 1):
                s = S[row, 2 * order[j // 2] + j % 2]
                end = min(j, 2 * k)
                for i in range(end):
                    s -= L[r, i] * L[j, i]
                L[r, j] = s / L[j, j] if j < 2 * k else s
        n = 2 * k
        a, b, d = L[n, n], L[n + 1, n], L[n + 1, n + 1]
        narrow[k, 0], narrow[k, 1], narrow[k, 2] = a, b, d
        L[n, n] = math.sqrt(max(a, 0.0) + var)
        L[n + 1, n] = b / L[n, n]
        L[n + 1, n + 1] = math.sqrt(max(d + var - L[n + 1, n] ** 2, var))


@njit(cache=True, error_model="numpy")
def _in_gate(expected: Array, S: Array, uv: Array, var: Array, gate: float, cand: Indices) -> int:
    """The detections in a light's gate, the likeliest first: fills `cand` (N,), returns how many."""
    a, b, d = S[0, 0], S[0, 1], S[1, 1]
    costs, n = np.empty(len(uv)), 0
    for i in range(len(uv)):
        du, dv = uv[i, 0] - expected[0], uv[i, 1] - expected[1]
        a1, d1 = a + var[i], d + var[i]
        det = a1 * d1 - b * b
        nis = (d1 * du * du - 2.0 * b * du * dv + a1 * dv * dv) / det
        if not nis < gate:
            continue
        cost, k = nis + math.log(det), n
        while k > 0 and costs[k - 1] > cost:
            costs[k], cand[k] = costs[k - 1], cand[k - 1]
            k -= 1
        costs[k], cand[k] = cost, i
        n += 1
    return n


@njit(cache=True, error_model="numpy")
def _name_one(
    expected: Array,
    S: Array,
    L: Array,
    w: Array,
    chosen: Indices,
    count: int,
    c: int,
    uv: Array,
    var: float,
    gate: float,
) -> float:
    """Cost of naming one detection given the `count` `chosen` before; NaN outside the gate.

    Adds two rows to the Cholesky factor `L` of the joint covariance and to the whitened innovation `w`.
    """
    n = 2 * count
    a, b, d = S[2 * c, 2 * c] + var, S[2 * c, 2 * c + 1], S[2 * c + 1, 2 * c + 1] + var
    du, dv = uv[0] - expected[c, 0], uv[1] - expected[c, 1]
    for r in range(n):
        col = 2 * chosen[r // 2] + r % 2
        su, sv = S[2 * c, col], S[2 * c + 1, col]
        for k in range(r):
            su -= L[r, k] * L[n, k]
            sv -= L[r, k] * L[n + 1, k]
        su, sv = su / L[r, r], sv / L[r, r]
        L[n, r], L[n + 1, r] = su, sv
        a -= su * su
        b -= su * sv
        d -= sv * sv
        du -= su * w[r]
        dv -= sv * w[r]
    det = a * d - b * b
    if not (a > 0.0 and det > 0.0):
        return np.nan
    nis = (d * du * du - 2.0 * b * du * dv + a * dv * dv) / det
    if not nis < gate:
        return np.nan
    L[n, n] = math.sqrt(a)
    L[n + 1, n] = b / L[n, n]
    L[n + 1, n + 1] = math.sqrt(det / a)
    w[n] = du / L[n, n]
    w[n + 1] = (dv - L[n + 1, n] * w[n]) / L[n + 1, n + 1]
    return 0.5 * (nis + math.log(det)) + _LOG_2PI


@njit(cache=True, error_model="numpy")
def _keep(name: Indices, cost: float, names: Indices, costs: Array, found: int) -> int:
    """Put a naming into the sorted list."""
    k = len(costs)
    if found == k and cost >= costs[k - 1]:
        return found
    if found < k:
        found += 1
    at = found - 1
    while at > 0 and costs[at - 1] > cost:
        costs[at] = costs[at - 1]
        names[at] = names[at - 1]
        at -= 1
    costs[at] = cost
    names[at] = name
    return found


@njit(cache=True, error_model="numpy")
def _tilt(R: Array, t: Array, plane: Array, turn_cov: Array, q: Array, axis: Array) -> tuple[float, float]:
    """Angle rad between a plane's normal and the line of sight to its point, and its sigma.

    Fills the point `q` (3,) in `cam` and the `axis` (3,) in `dock` that turns the normal onto the line of sight.
    """
    n, a = np.empty(3), np.empty(3)
    for i in range(3):
        q[i] = R[i, 0] * plane[0] + R[i, 1] * plane[1] + R[i, 2] * plane[2] + t[i]
        n[i] = R[i, 0] * plane[3] + R[i, 1] * plane[4] + R[i, 2] * plane[5]
    r = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    if n[0] * q[0] + n[1] * q[1] + n[2] * q[2] > 0.0:  # the normal toward the camera
        n *= -1.0
    a[0], a[1], a[2] = n[2] * q[1] - n[1] * q[2], n[0] * q[2] - n[2] * q[0], n[1] * q[0] - n[0] * q[1]
    sine = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    if sine < 1e-9 * r:
        a[0], a[1], a[2], sine = R[0, 0], R[1, 0], R[2, 0], 1e-12
    else:
        a /= sine
    tilt, var = math.atan2(sine, -(n[0] * q[0] + n[1] * q[1] + n[2] * q[2])), 0.0
    for i in range(3):
        axis[i] = R[0, i] * a[0] + R[1, i] * a[1] + R[2, i] * a[2]
    for i in range(3):
        for j in range(3):
            var += axis[i] * turn_cov[i, j] * axis[j]
    return tilt, math.sqrt(max(var, 0.0))


@njit(cache=True, error_model="numpy")
def _flatten(R: Array, t: Array, plane: Array, turn_cov: Array, Rf: Array, tf: Array) -> None:
    """Turn the plane about its point toward the camera, by three sigmas of its tilt at most."""
    q, d = np.empty(3), np.empty(3)
    tilt, sigma = _tilt(R, t, plane, turn_cov, q, d)
    turn = min(tilt, 3.0 * sigma)
    Rf[:] = R
    rotate_exp(Rf, turn * d[0], turn * d[1], turn * d[2])
    for i in range(3):
        tf[i] = q[i] - (Rf[i, 0] * plane[0] + Rf[i, 1] * plane[1] + Rf[i, 2] * plane[2])


@njit(cache=True, error_model="numpy")
def update(
    lens: Array,
    R0: Array,
    t0: Array,
    R: Array,
    t: Array,
    x: Array,
    P: Array,
    p: Array,
    name: Indices,
    uv: Array,
    cov: Array,
    estimated: int,
    steps: int,
    plane: Array,
    turn_cov: Array,
    tracking: bool,
    apart: Array,
) -> float:
    """Take in the named pixels, all in one, relinearised up to `steps` times; in place. Returns the NIS.

    `R0`, `t0` are the mean that `P` belongs to, `R`, `t` where to linearise first. Where the lights are one `plane`
    (6,) (a point and the normal; NaN: none), the covariance is that of the flattest view within three sigmas of tilt by
    `turn_cov` (3, 3): seen at a slant by mistake, a plane would seem to tell its tilt. When `tracking` the gain is that
    of the flattest view as well, so that history rests on perspective and not on the choice between two slants.

    Only the first `estimated` states move; the others are considered: they keep their covariance and lend it to the
    rest (S. F. Schmidt, 1966). `apart` (M, 18) is, for each named light, how far the nine `outputs` would move without
    it, and the variance that leaving it out adds to each. NIS is NaN on failure.
    """
    n, m = len(P), 0
    lights = np.empty(len(name), np.int64)
    for c in range(len(name)):
        if name[c] >= 0:
            lights[m] = c
            m += 1
    x0 = x.copy()
    G, Z = np.empty((2 * m, n)), np.empty((2 * m, 2 * m))
    nu, w, dx, before = np.empty(2 * m), np.empty(2 * m), np.zeros(n), np.zeros(6)
    rows, cals, at = np.empty((m, 14)), np.empty((m, 4)), np.empty(3)
    Rf, tf, h, cal = R.copy(), t.copy(), np.empty(14), np.empty(4)
    plain = math.isnan(plane[0])
    change = 0.0
    _difference(R0, t0, R, t, dx)
    for step in range(steps):
        Rf[:], tf[:] = R, t
        if not plain and tracking:
            _flatten(R, t, plane, turn_cov, Rf, tf)
        if not _whiten(lens, Rf, tf, x, P, p, name, lights, m, cov, rows, cals, G, Z):
            return np.nan
        for k in range(m):
            i = name[lights[k]]
            if not plain and tracking:
                if not _row(lens, R, t, x, p, lights[k], at, h, cal):
                    return np.nan
                rows[k, 0], rows[k, 1] = h[0], h[1]
            nu[2 * k] = uv[i, 0] - rows[k, 0] + _dot_row(dx, rows[k], 2, cals[k, 0], CALIBRATION + 1, lights[k])
            nu[2 * k + 1] = uv[i, 1] - rows[k, 1] + _dot_row(dx, rows[k], 8, cals[k, 1], CALIBRATION + 2, lights[k])
        dx[:] = 0.0
        for r in range(2 * m):
            s = nu[r]
            for k in range(r):
                s -= Z[r, k] * w[k]
            w[r] = s / Z[r, r]
            for j in range(estimated):
                dx[j] += w[r] * G[r, j]
        R[:], t[:], x[:] = R0, t0, x0
        _apply(R, t, x, dx, estimated)
        change = 0.0  # of the pose since the step before, in sigmas of the prediction
        for j in range(6):
            change = max(change, abs(dx[j] - before[j]) / math.sqrt(P[j, j]))
            before[j] = dx[j]
        if step > 0 and change < 0.02:
            break
        if step == 0 and change < 0.3 and P[3, 3] + P[4, 4] + P[5, 5] < 1e-4:
            break
    if tracking and change > _SETTLED:
        return np.nan
    nis = 0.0
    for r in range(2 * m):
        nis += w[r] * w[r]
    Rf[:], tf[:] = R, t
    if not plain:
        _flatten(R, t, plane, turn_cov, Rf, tf)
        if not _whiten(lens, Rf, tf, x, P, p, name, lights, m, cov, rows, cals, G, Z):
            return np.nan
        for r in range(2 * m):
            s = nu[r]
            for k in range(r):
                s -= Z[r, k] * w[k]
            w[r] = s / Z[r, r]
    for r in range(2 * m):
        for i in range(n):
            g = G[r, i]
            end = n if i < estimated else estimated
            for j in range(end):
                P[i, j] -= g * G[r, j]
    _separate(Z, G, w, outputs(R, t), lights, m, apart)
    return nis


@njit(cache=True, error_model="numpy")
def _whiten(
    lens: Array,
    R: Array,
    t: Array,
    x: Array,
    P: Array,
    p: Array,
    name: Indices,
    lights: Indices,
    m: int,
    cov: Array,
    rows: Array,
    cals: Array,
    G: Array,
    Z: Array,
) -> bool:
    """Fill `rows`, `cals` of `m` named lights, `Z`, the factor L of their innovation's covariance, and `G`, L^-1 H P.

    False where a light is out of the lens's sight.
    """
    n, at = len(P), np.empty(3)
    for k in range(m):
        if not _row(lens, R, t, x, p, lights[k], at, rows[k], cals[k]):
            return False
        _gains(P, rows[k], cals[k], lights[k], G[2 * k], G[2 * k + 1])
    for k in range(m):
        c, i = lights[k], name[lights[k]]
        for r in range(2 * k, 2 * m):
            Z[r, 2 * k] = _dot_row(G[r], rows[k], 2, cals[k, 0], CALIBRATION + 1, c)
            Z[r, 2 * k + 1] = _dot_row(G[r], rows[k], 8, cals[k, 1], CALIBRATION + 2, c)
        Z[2 * k, 2 * k] += cov[i, 0, 0]
        Z[2 * k + 1, 2 * k] += cov[i, 1, 0]
        Z[2 * k + 1, 2 * k + 1] += cov[i, 1, 1]
    if math.isnan(factor(Z, 2 * m)):
        return False
    for r in range(2 * m):
        for k in range(r):
            z = Z[r, k]
            for j in range(n):
                G[r, j] -= z * G[k, j]
        z = 1.0 / Z[r, r]
        for j in range(n):
            G[r, j] *= z
    return True


@njit(cache=True, error_model="numpy")
def _separate(Z: Array, G: Array, w: Array, C: Array, lights: Indices, m: int, apart: Array) -> None:
    """One-fault solution separation: what leaving each of `m` lights out of the update would do to the outputs `C`.

    With S = L L^T the innovation's covariance (`Z`), `G` = L^-1 H P, `w` = L^-1 nu and V the columns of L^-1 that
    belong to a light's two rows, leaving them out moves the state by -G^T V (V^T V)^-1 V^T w and adds the variance
    G^T V (V^T V)^-1 V^T G: block elimination, exact also where states are only considered.
    """
    V, U = np.empty((2 * m, 2)), np.empty((9, 2))
    apart[:] = 0.0
    for k in range(m):
        a = b = d = wu = wv = 0.0
        for r in range(2 * k, 2 * m):
            for o in range(2):
                s = 1.0 if r == 2 * k + o else 0.0
                for q in range(2 * k, r):
                    s -= Z[r, q] * V[q, o]
                V[r, o] = s / Z[r, r]
            a += V[r, 0] * V[r, 0]
            b += V[r, 0] * V[r, 1]
            d += V[r, 1] * V[r, 1]
            wu += V[r, 0] * w[r]
            wv += V[r, 1] * w[r]
        det = a * d - b * b
        for j in range(9):
            U[j, 0] = U[j, 1] = 0.0
            for o in range(6):
                gu = gv = 0.0
                for r in range(2 * k, 2 * m):
                    gu += G[r, o] * V[r, 0]
                    gv += G[r, o] * V[r, 1]
                U[j, 0] += C[j, o] * gu
                U[j, 1] += C[j, o] * gv
        c = lights[k]
        for j in range(9):
            u, v = (d * U[j, 0] - b * U[j, 1]) / det, (a * U[j, 1] - b * U[j, 0]) / det
            apart[c, j] = -(u * wu + v * wv)
            apart[c, 9 + j] = u * U[j, 0] + v * U[j, 1]


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _largest2(a: float, b: float, c: float) -> float:
    """Largest eigenvalue of [[a, b], [b, c]]."""
    return 0.5 * (a + c) + math.sqrt(0.25 * (a - c) * (a - c) + b * b)


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def levels(
    R: Array,
    t: Array,
    P: Array,
    apart: Array,
    plane: Array,
    k_free: Array,
    k_fault: Array,
    separate: bool,
    cov: Array,
) -> tuple[float, float, float, float, float]:
    """Protection levels: lateral m, axial m, angle rad, bearing rad, range m; `cov` (9, 9) of `outputs` is filled.

    `k_free` and `k_fault` (3,) are the factors on sigma in one, two and three dimensions without a fault and with one
    light at fault; with `separate` every light of `apart` may be. A tilted `plane` looks smaller by its square: range
    and axial levels have room for what the tilt's spread can do to them.
    """
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
    if separate:
        for c in range(len(apart)):
            a = apart[c]
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
        tilt, sigma = _tilt(R, t, plane, P[3:6, 3:6], q, axis)
        far = tilt + _TILT_SIGMAS * sigma
        shrunk = 0.25 * (far * far - tilt * tilt) * math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
        pl1, pl4 = pl1 + shrunk, pl4 + shrunk
    return pl0, pl1, pl2, pl3, pl4

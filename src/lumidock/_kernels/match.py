"""The search for the most probable naming of detections without history, and the rivals next to it.

Arrays of one frame: `uv` (N, 2) px, `var` (N,) px^2, `like` (N, L) log likelihood ratio of each detection for each
layer, `log_clutter` (N + 1,) log price of naming so many detections. Of the station: `p` (M, 3), `layer` (M,), `axis`
(M, 3), `survey_m2` (M,) variance of a light's position, `rank` (M,) in its layer. A hypothesis is `name` (M,): the
detection that each light is given, or -1; and its pose `R`, `t` of T_cam_dock.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lumidock._kernels.lens import inside, invert6
from lumidock._kernels.pose import flip, light_row, normal_equations, refine
from lumidock.datatypes import Array, Indices

# entries of the parameters `q`
LOG_VOLUME, DETECT, ABSENT, GATE, NEAR_M, FAR_M, ROLL_GATE, BEND, STEADY, STEADIER = range(10)
_LOG_2PI = math.log(2.0 * math.pi)
_EDGE_PX, _SHINES = 3.0, 0.1  # a light this near the edge, or seen this flat (cosine), may be missing at no cost
_SAME_TURN = 2e-3  # rad; closer solutions are one
_THIRDS, _ALL_THIRDS = 3, 24  # third lights tried for a pair; and where three are all there may be
_BRANCHES = 2  # first lights of another layer tried
_HUGE = 1e300


@njit(cache=True, error_model="numpy")
def depth(R: Array, t: Array, p: Array) -> float:
    """Depth z m in `cam` of the light at `p` (3,)."""
    return R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + t[2]


@njit(cache=True, error_model="numpy")
def _survey_var(lens: Array, R: Array, t: Array, p: Array, survey_m2: float) -> float:
    """Variance px^2 that a light's survey error adds."""
    z = max(depth(R, t, p), 0.05)
    return survey_m2 * lens[1] * lens[2] / (z * z)


@njit(cache=True, error_model="numpy")
def fit(
    name: Indices,
    lens: Array,
    p: Array,
    survey_m2: Array,
    uv: Array,
    var: Array,
    R: Array,
    t: Array,
    Rp: Array,
    info: Array,
    steps: int,
    H: Array,
    L: Array,
) -> tuple[float, float, float]:
    """Most probable pose of the named lights, in place: cost, log det H, and the sum of log(2 pi variance)."""
    m = len(name)
    ps, uvs, vs = np.empty((m, 3)), np.empty((m, 2)), np.empty(m)
    n, log_var = 0, 0.0
    for c in range(m):
        i = name[c]
        if i < 0:
            continue
        ps[n] = p[c]
        uvs[n] = uv[i]
        vs[n] = var[i] + _survey_var(lens, R, t, p[c], survey_m2[c])
        log_var += _LOG_2PI + math.log(vs[n])
        n += 1
    cost, log_det = refine(lens, ps, uvs, vs, n, R, t, Rp, info, steps, H, L)
    return cost, log_det, log_var


@njit(cache=True, error_model="numpy")
def log_evidence(
    name: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    axis: Array,
    like: Array,
    log_clutter: Array,
    R: Array,
    t: Array,
    info: Array,
    q: Array,
    cost: float,
    log_det: float,
    log_var: float,
) -> float:
    """Log evidence of a hypothesis over "all clutter", the pose integrated out by Laplace's method."""
    if math.isnan(cost) or math.isnan(log_det):
        return -_HUGE
    total = 1.5 * _LOG_2PI - 0.5 * log_det - 0.5 * cost - log_var - log_clutter[_named(name)]
    distance = max(math.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]), q[NEAR_M])
    # position prior: half flat inside the view cone, half flat in the logarithm of the distance
    near = (q[FAR_M] / distance) ** 3 / (3.0 * math.log(q[FAR_M] / q[NEAR_M]))
    total += math.log(0.5 + 0.5 * near) - q[LOG_VOLUME]
    for k in range(3):
        total += 0.5 * math.log(info[k])
    layers = like.shape[1]
    matched, missed = np.zeros(layers, np.int64), np.zeros(layers, np.int64)
    h, away = np.empty(14), np.empty(3)
    for c in range(len(name)):
        i = name[c]
        if i >= 0:
            total += math.log(q[DETECT]) + like[i, layer[c]]
            matched[layer[c]] += 1
        elif light_row(lens, R, t, p[c], h) and inside(lens, h[0], h[1], _EDGE_PX):
            norm, along = 0.0, 0.0
            for k in range(3):  # the camera stands at -R^T t
                away[k] = -(R[0, k] * t[0] + R[1, k] * t[1] + R[2, k] * t[2]) - p[c, k]
                norm += away[k] * away[k]
                along += away[k] * axis[c, k]
            missed[layer[c]] += along > _SHINES * math.sqrt(norm)
    for k in range(layers):
        miss = missed[k] * math.log(1.0 - q[DETECT])
        if matched[k] == 0 and missed[k] > 0:
            miss = math.log(q[ABSENT] + (1.0 - q[ABSENT]) * math.exp(miss))
        total += miss
    return total


@njit(cache=True, error_model="numpy")
def evidence(
    name: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    axis: Array,
    survey_m2: Array,
    uv: Array,
    var: Array,
    like: Array,
    log_clutter: Array,
    R: Array,
    t: Array,
    Rp: Array,
    info: Array,
    q: Array,
    steps: int,
    H: Array,
    L: Array,
) -> float:
    """Log evidence of a naming whose pose is solved anew, in place, under the whole attitude prior.

    The prior is a mixture: a share `STEADY` of vehicles holds its attitude `STEADIER` times (in variance) better.
    `H` is left with the normal matrix under the wide part.
    """
    Rn, tn, Hn = np.empty((3, 3)), np.empty(3), np.empty((6, 6))
    cost, log_det, log_var = fit(name, lens, p, survey_m2, uv, var, R, t, Rp, info, steps, H, L)
    wide = log_evidence(name, lens, p, layer, axis, like, log_clutter, R, t, info, q, cost, log_det, log_var)
    if q[STEADY] <= 0.0 or wide <= -_HUGE:
        return wide
    Rn[:], tn[:] = R, t
    close = info * q[STEADIER]
    cost, log_det, log_var = fit(name, lens, p, survey_m2, uv, var, Rn, tn, Rp, close, steps, Hn, L)
    narrow = log_evidence(name, lens, p, layer, axis, like, log_clutter, Rn, tn, close, q, cost, log_det, log_var)
    return _log_add(wide + math.log(1.0 - q[STEADY]), narrow + math.log(q[STEADY]))


@njit(cache=True, error_model="numpy")
def _log_add(a: float, b: float) -> float:
    high, low = max(a, b), min(a, b)
    return high if low < high - 40.0 else high + math.log1p(math.exp(low - high))


@njit(cache=True, error_model="numpy")
def _innovation(h: Array, P: Array, extra: float, S: Array) -> None:
    """S (3,) = uu, uv, vv of the predicted pixel's covariance, `extra` px^2 on its diagonal."""
    S[0], S[1], S[2] = extra, 0.0, extra
    for i in range(6):
        a, b = 0.0, 0.0
        for j in range(6):
            a += P[i, j] * h[2 + j]
            b += P[i, j] * h[8 + j]
        S[0] += h[2 + i] * a
        S[1] += h[2 + i] * b
        S[2] += h[8 + i] * b


@njit(cache=True, error_model="numpy")
def _best_light(
    allowed: int,
    name: Indices,
    taken: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    survey_m2: Array,
    uv: Array,
    var: Array,
    like: Array,
    R: Array,
    t: Array,
    P: Array,
    gate: float,
    bend: float,
    after: int,
    rank: Indices,
    out: Array,
) -> int:
    """The unnamed lights of layer `allowed` (-1: any) with a detection inside their gate, cheapest first.

    Only those whose `rank` (M,) is over `after`.

    Fills rows of `out` (K, 3) with NIS + log det S - 2 log likelihood, light and detection; returns how many.
    """
    h, S = np.empty(14), np.empty(3)
    found, keep = 0, len(out)
    mu, mv = _mean_named(name, uv)
    for c in range(len(name)):
        if name[c] >= 0 or rank[c] <= after or (allowed >= 0 and layer[c] != allowed):
            continue
        if not light_row(lens, R, t, p[c], h):
            continue
        extra = _survey_var(lens, R, t, p[c], survey_m2[c])
        extra += bend * ((h[0] - mu) ** 2 + (h[1] - mv) ** 2)
        _innovation(h, P, extra, S)
        # spots beyond the larger half axis of the gate need no closer look
        reach = math.sqrt(gate * (S[0] + S[2])) + 30.0
        for i in range(len(uv)):
            du, dv = uv[i, 0] - h[0], uv[i, 1] - h[1]
            if taken[i] >= 0 or abs(du) > reach or abs(dv) > reach:
                continue
            s0, s1, s2 = S[0] + var[i], S[1], S[2] + var[i]
            det = s0 * s2 - s1 * s1
            nis = (s2 * du * du - 2.0 * s1 * du * dv + s0 * dv * dv) / det
            if nis > gate:
                continue
            price = nis + math.log(det) - 2.0 * like[i, layer[c]]
            if found < keep:
                found += 1
            elif price >= out[keep - 1, 0]:
                continue
            at = found - 1
            while at > 0 and out[at - 1, 0] > price:
                out[at] = out[at - 1]
                at -= 1
            out[at, 0], out[at, 1], out[at, 2] = price, c, i
    return found


@njit(cache=True, error_model="numpy")
def _mean_named(name: Indices, uv: Array) -> tuple[float, float]:
    """Mean pixel of the named detections."""
    mu, mv, n = 0.0, 0.0, 0
    for c in range(len(name)):
        if name[c] >= 0:
            mu += uv[name[c], 0]
            mv += uv[name[c], 1]
            n += 1
    return mu / n, mv / n


@njit(cache=True, error_model="numpy")
def grow(
    allowed: int,
    name: Indices,
    taken: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    survey_m2: Array,
    rank: Indices,
    uv: Array,
    var: Array,
    like: Array,
    R: Array,
    t: Array,
    Rp: Array,
    info: Array,
    q: Array,
    work: Array,
) -> tuple[float, float, float]:
    """Name light after light, the cheapest first, solving the pose anew after each. Returns what `fit` does."""
    H, L, P = work[0], work[1], work[2]
    out = np.empty((1, 3))
    cost, log_det, log_var = fit(name, lens, p, survey_m2, uv, var, R, t, Rp, info, 6, H, L)
    for _ in range(len(name)):
        if math.isnan(log_det) or math.isnan(invert6(H, L, P)):
            return np.nan, np.nan, 0.0
        if not _best_light(
            allowed, name, taken, lens, p, layer, survey_m2, uv, var, like, R, t, P, q[GATE], 0.0, -1, rank, out
        ):
            break
        c, i = int(out[0, 1]), int(out[0, 2])
        name[c], taken[i] = i, c
        cost, log_det, log_var = fit(name, lens, p, survey_m2, uv, var, R, t, Rp, info, 4, H, L)
    return cost, log_det, log_var


@njit(cache=True, error_model="numpy")
def _reachable(
    allowed: int,
    name: Indices,
    taken: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    survey_m2: Array,
    uv: Array,
    R: Array,
    t: Array,
    P: Array,
    q: Array,
) -> int:
    """How many unnamed lights of one layer have a detection within the reach of their gate."""
    h, S = np.empty(14), np.empty(3)
    mu, mv = _mean_named(name, uv)
    count = 0
    for c in range(len(name)):
        if name[c] >= 0 or layer[c] != allowed or not light_row(lens, R, t, p[c], h):
            continue
        extra = 1.0 + _survey_var(lens, R, t, p[c], survey_m2[c]) + q[BEND] * ((h[0] - mu) ** 2 + (h[1] - mv) ** 2)
        _innovation(h, P, extra, S)
        det = q[GATE] * (S[0] * S[2] - S[1] * S[1])
        for i in range(len(uv)):
            du, dv = uv[i, 0] - h[0], uv[i, 1] - h[1]
            if taken[i] < 0 and S[2] * du * du - 2.0 * S[1] * du * dv + S[0] * dv * dv < det:
                count += 1
                break
    return count


@njit(cache=True, error_model="numpy")
def _pair_pose(d: Array, ray_i: Array, ray_j: Array, q: Array, out: Array) -> int:
    """Depth of the first light and roll that put two lights `d` (3,) apart in the prior's `cam` axes on two rays.

    Fills up to two rows of `out` (2, 2); returns how many lie within the gates.
    """
    xi, yi = ray_i[0] / ray_i[2], ray_i[1] / ray_i[2]
    xj, yj = ray_j[0] / ray_j[2], ray_j[1] / ray_j[2]
    dx, dy = xj - xi, yj - yi
    A = dx * dx + dy * dy
    B = d[2] * (dx * xj + dy * yj)
    C = d[2] * d[2] * (xj * xj + yj * yj) - (d[0] * d[0] + d[1] * d[1])
    root = B * B - A * C
    if A <= 0.0 or root < 0.0:
        return 0
    root = math.sqrt(root)
    found = 0
    for sign in (1.0, -1.0):
        z = (-B + sign * root) / A
        if not q[NEAR_M] < z < q[FAR_M] or z + d[2] < q[NEAR_M]:
            continue
        ex, ey = z * dx + d[2] * xj, z * dy + d[2] * yj
        roll = math.atan2(d[0] * ey - d[1] * ex, d[0] * ex + d[1] * ey)
        if abs(roll) > q[ROLL_GATE]:
            continue
        out[found, 0], out[found, 1] = z, roll
        found += 1
    return found


@njit(cache=True, error_model="numpy")
def _contains(names: Indices, count: int, a: int, i: int, b: int, j: int) -> bool:
    for k in range(count):  # noqa: SIM110 - numba compiles no generator
        if names[k, a] == i and names[k, b] == j:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _store(
    name: Indices, z: float, R: Array, t: Array, names: Indices, scores: Array, Rs: Array, ts: Array, count: int
) -> int:
    """Keep a hypothesis unless it is known or worse than all of a full list; returns how many there are."""
    for k in range(count):
        same = True
        for c in range(len(name)):
            if names[k, c] != name[c]:
                same = False
                break
        if same:
            if z > scores[k]:
                scores[k], Rs[k], ts[k] = z, R, t
            return count
    at = count
    if count == len(scores):
        at = int(np.argmin(scores))
        if scores[at] >= z:
            return count
    names[at], scores[at], Rs[at], ts[at] = name, z, R, t
    return max(count, at + 1)


@njit(cache=True, error_model="numpy")
def _others(
    name: Indices,
    taken: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    axis: Array,
    survey_m2: Array,
    rank: Indices,
    uv: Array,
    var: Array,
    like: Array,
    log_clutter: Array,
    R: Array,
    t: Array,
    Rp: Array,
    info: Array,
    q: Array,
    work: Array,
) -> float:
    """Extend a hypothesis of one layer to all, in place, over both poses of the plane and the first light beyond it.

    Growing greedily picks wrong where the tilt is open, so several first lights are tried. Returns the log evidence.
    """
    m = len(name)
    best_name, best_R, best_t, best = name.copy(), R.copy(), t.copy(), -_HUGE
    out, tops = np.empty((48, 3)), np.empty((_BRANCHES, 2))
    H, L, P = work[0], work[1], work[2]
    for mode in range(2):
        Rm, tm = R.copy(), t.copy()
        if mode == 1:
            ps, n = np.empty((m, 3)), 0
            for c in range(m):
                if name[c] >= 0:
                    ps[n] = p[c]
                    n += 1
            flip(ps, n, Rm, tm)
        cost, log_det, log_var = fit(name, lens, p, survey_m2, uv, var, Rm, tm, Rp, info, 12, H, L)
        z = log_evidence(name, lens, p, layer, axis, like, log_clutter, Rm, tm, info, q, cost, log_det, log_var)
        if mode == 1 and (z < best - 30.0 or _turn(Rm, R) < _SAME_TURN):
            break
        if mode == 0:
            R[:], t[:] = Rm, tm
        if z > best:
            best, best_name[:], best_R[:], best_t[:] = z, name, Rm, tm
        if z <= -_HUGE or math.isnan(invert6(H, L, P)):
            continue
        found = _best_light(
            -1, name, taken, lens, p, layer, survey_m2, uv, var, like, Rm, tm, P, q[GATE], 0.0, -1, rank, out
        )
        kept = _most_supported(out, found, name, taken, lens, p, layer, survey_m2, uv, var, Rm, tm, P, q[GATE], tops)
        for k in range(kept):
            trial, held, Rk, tk = name.copy(), taken.copy(), Rm.copy(), tm.copy()
            c, i = int(out[int(tops[k, 1]), 1]), int(out[int(tops[k, 1]), 2])
            trial[c], held[i] = i, c
            cost, log_det, log_var = grow(
                -1, trial, held, lens, p, layer, survey_m2, rank, uv, var, like, Rk, tk, Rp, info, q, work
            )
            z = log_evidence(trial, lens, p, layer, axis, like, log_clutter, Rk, tk, info, q, cost, log_det, log_var)
            if z > best:
                best, best_name[:], best_R[:], best_t[:] = z, trial, Rk, tk
    name[:], R[:], t[:] = best_name, best_R, best_t
    return best


@njit(cache=True, error_model="numpy")
def _turn(Ra: Array, Rb: Array) -> float:
    """Angle rad between two rotations, small or not."""
    s = 0.0
    for i in range(3):
        for j in range(3):
            s += (Ra[i, j] - Rb[i, j]) ** 2
    return math.sqrt(0.5 * s)


@njit(cache=True, error_model="numpy")
def _support(
    c: int,
    i: int,
    name: Indices,
    taken: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    survey_m2: Array,
    uv: Array,
    var: Array,
    R: Array,
    t: Array,
    P: Array,
    gate: float,
    bend: float,
) -> int:
    """How many other lights of the layer of light `c` find a detection in place once detection `i` is named after it.

    By one linear update of the pose and its covariance `P`.
    """
    h, S = np.empty(14), np.empty(3)
    P2, gain, shift = np.empty((6, 6)), np.empty((6, 2)), np.empty(6)
    light_row(lens, R, t, p[c], h)
    mu, mv = _mean_named(name, uv)
    extra = var[i] + _survey_var(lens, R, t, p[c], survey_m2[c])
    _innovation(h, P, extra + bend * ((h[0] - mu) ** 2 + (h[1] - mv) ** 2), S)
    _condition(h, P, S, uv[i, 0] - h[0], uv[i, 1] - h[1], P2, gain, shift)
    support = 0
    for c2 in range(len(name)):
        if c2 == c or name[c2] >= 0 or layer[c2] != layer[c] or not light_row(lens, R, t, p[c2], h):
            continue
        extra = 1.0 + _survey_var(lens, R, t, p[c2], survey_m2[c2])
        _innovation(h, P2, extra + bend * ((h[0] - mu) ** 2 + (h[1] - mv) ** 2), S)
        u, v = h[0], h[1]
        for n in range(6):
            u += h[2 + n] * shift[n]
            v += h[8 + n] * shift[n]
        det = S[0] * S[2] - S[1] * S[1]
        for j in range(len(uv)):
            if j == i or taken[j] >= 0:
                continue
            du, dv = uv[j, 0] - u, uv[j, 1] - v
            if S[2] * du * du - 2.0 * S[1] * du * dv + S[0] * dv * dv < gate * det:
                support += 1
                break
    return support


@njit(cache=True, error_model="numpy")
def _most_supported(
    out: Array,
    found: int,
    name: Indices,
    taken: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    survey_m2: Array,
    uv: Array,
    var: Array,
    R: Array,
    t: Array,
    P: Array,
    gate: float,
    tops: Array,
) -> int:
    """Which first lights of another layer, rows of `out`, have most support there; into `tops`, best first."""
    kept = 0
    for k in range(found):
        c, i = int(out[k, 1]), int(out[k, 2])
        support = _support(c, i, name, taken, lens, p, layer, survey_m2, uv, var, R, t, P, 2.0 * gate, 0.0)
        worth = support - 1e-3 * out[k, 0]
        if kept < len(tops):
            kept += 1
        elif worth <= tops[kept - 1, 0]:
            continue
        at = kept - 1
        while at > 0 and tops[at - 1, 0] < worth:
            tops[at] = tops[at - 1]
            at -= 1
        tops[at, 0], tops[at, 1] = worth, k
    return kept


@njit(cache=True, error_model="numpy")
def _condition(h: Array, P: Array, S: Array, du: float, dv: float, P2: Array, gain: Array, shift: Array) -> None:
    """Kalman update of a pose's covariance `P` by one pixel: `P2`, and the `shift` (6,) of the pose."""
    det = S[0] * S[2] - S[1] * S[1]
    for n in range(6):
        a, b = 0.0, 0.0
        for k in range(6):
            a += P[n, k] * h[2 + k]
            b += P[n, k] * h[8 + k]
        gain[n, 0], gain[n, 1] = (S[2] * a - S[1] * b) / det, (S[0] * b - S[1] * a) / det
        shift[n] = gain[n, 0] * du + gain[n, 1] * dv
    for n in range(6):
        for k in range(6):
            a, b = 0.0, 0.0
            for m in range(6):
                a += h[2 + m] * P[m, k]
                b += h[8 + m] * P[m, k]
            P2[n, k] = P[n, k] - gain[n, 0] * a - gain[n, 1] * b


@njit(cache=True, error_model="numpy")
def search(
    lens: Array,
    p: Array,
    layer: Indices,
    axis: Array,
    survey_m2: Array,
    rank: Indices,
    uv: Array,
    ray: Array,
    var: Array,
    like: Array,
    log_clutter: Array,
    Rp: Array,
    info: Array,
    q: Array,
    pairs: Indices,
    unseen: Indices,
    floor: int,
    least: int,
    best: float,
    count: int,
    names: Indices,
    scores: Array,
    Rs: Array,
    ts: Array,
) -> int:
    """Add the best hypotheses to the list `names` (K, M), `scores` (K,), `Rs`, `ts` of `count`. Returns how many.

    `pairs` (S, 2) are lights of one layer, in order; `unseen` (S,) is the most lights of one layer that a hypothesis
    can name without naming any pair before that one. The search stops when what it has not seen cannot come within one
    light of the best, nor within two in any one layer, so that it is exhaustive in what matters. `floor` is that bound
    at the start; `least` how many lights of one layer a hypothesis must name, `best` a log evidence to measure up to. A
    third light comes after both of a pair in `rank` (M,), so that each triple is tried once.
    """
    m, n = len(p), len(uv)
    work = np.empty((3, 6, 6))
    H, L, P = work[0], work[1], work[2]
    sols, thirds = np.empty((2, 2)), np.empty((_THIRDS if least > 3 else _ALL_THIRDS, 3))
    name, taken = np.empty(m, np.int64), np.empty(n, np.int64)
    ps, uvs, vs = np.empty((2, 3)), np.empty((2, 2)), np.empty(2)
    R0, t0, R, t, d = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    g = np.empty(6)
    most, layers = floor, like.shape[1]
    in_layer = floor - 1 if floor > least else 0  # lights of one layer that a hypothesis must name at least
    for k in range(count):
        best = max(best, scores[k])
    for s in range(len(pairs)):
        wanted = max(least, in_layer, (max(most, floor) + layers - 1) // layers)
        if unseen[s] < wanted:
            break
        a, b = pairs[s, 0], pairs[s, 1]
        for k in range(3):  # R_cam_dock of the prior is Rp^T
            d[k] = 0.0
            for o in range(3):
                d[k] += Rp[o, k] * (p[b, o] - p[a, o])
        for i in range(n):
            if not ray[i, 2] > 0.0:
                continue
            for j in range(n):
                if i == j or not ray[j, 2] > 0.0:
                    continue
                for sol in range(_pair_pose(d, ray[i], ray[j], q, sols)):
                    if _contains(names, count, a, i, b, j):
                        break
                    z, roll = sols[sol, 0], sols[sol, 1]
                    _pose_of(Rp, roll, z, ray[i], p[a], R0, t0)
                    # two lights and the prior: where may the third be?
                    ps[0], ps[1], uvs[0], uvs[1] = p[a], p[b], uv[i], uv[j]
                    vs[0] = var[i] + _survey_var(lens, R0, t0, p[a], survey_m2[a])
                    vs[1] = var[j] + _survey_var(lens, R0, t0, p[b], survey_m2[b])
                    cost = normal_equations(lens, ps, uvs, vs, 2, R0, t0, Rp, info, H, g)
                    if math.isnan(cost) or math.isnan(invert6(H, L, P)):
                        continue
                    name[:] = -1
                    taken[:] = -1
                    name[a], name[b], taken[i], taken[j] = i, j, a, b
                    found = _best_light(
                        layer[a],
                        name,
                        taken,
                        lens,
                        p,
                        layer,
                        survey_m2,
                        uv,
                        var,
                        like,
                        R0,
                        t0,
                        P,
                        q[GATE],
                        q[BEND],
                        max(rank[a], rank[b]),
                        rank,
                        thirds,
                    )
                    wanted = max(least, in_layer, (max(most, floor) + layers - 1) // layers)
                    if wanted > 3 and _reachable(layer[a], name, taken, lens, p, layer, survey_m2, uv, R0, t0, P, q) < (
                        wanted - 2
                    ):
                        continue
                    for k in range(found):
                        c, o = int(thirds[k, 1]), int(thirds[k, 2])
                        name[:] = -1
                        taken[:] = -1
                        name[a], name[b], taken[i], taken[j] = i, j, a, b
                        if _contains(names, count, a, i, c, o) and _contains(names, count, b, j, c, o):
                            continue
                        wanted = max(least, in_layer, (max(most, floor) + layers - 1) // layers)
                        if wanted > 3 and wanted > 3 + _support(
                            c, o, name, taken, lens, p, layer, survey_m2, uv, var, R0, t0, P, q[GATE], q[BEND]
                        ):
                            continue
                        name[c], taken[o] = o, c
                        R[:], t[:] = R0, t0
                        cost, log_det, log_var = grow(
                            layer[a],
                            name,
                            taken,
                            lens,
                            p,
                            layer,
                            survey_m2,
                            rank,
                            uv,
                            var,
                            like,
                            R,
                            t,
                            Rp,
                            info,
                            q,
                            work,
                        )
                        e = log_evidence(
                            name, lens, p, layer, axis, like, log_clutter, R, t, info, q, cost, log_det, log_var
                        )
                        if e <= -_HUGE or _named(name) < least:
                            continue
                        if e > best - 10.0 or (e > 0.0 and _named(name) > 3):
                            e = _others(
                                name,
                                taken,
                                lens,
                                p,
                                layer,
                                axis,
                                survey_m2,
                                rank,
                                uv,
                                var,
                                like,
                                log_clutter,
                                R,
                                t,
                                Rp,
                                info,
                                q,
                                work,
                            )
                        if _named(name) < floor:
                            continue
                        count = _store(name, e, R, t, names, scores, Rs, ts, count)
                        if e > best:
                            best = e
                            if e > 0.0:
                                most = max(most, _named(name) - 1)
                                in_layer = max(in_layer, _most_in_layer(name, layer, layers) - 2)
    for k in range(count):
        scores[k] = evidence(
            names[k], lens, p, layer, axis, survey_m2, uv, var, like, log_clutter, Rs[k], ts[k], Rp, info, q, 6, H, L
        )
    return count


@njit(cache=True, error_model="numpy")
def _pose_of(Rp: Array, roll: float, z: float, ray: Array, p: Array, R: Array, t: Array) -> None:
    """Pose of the prior attitude turned by `roll`, with the light at `p` at depth `z` on `ray`."""
    c, s = math.cos(roll), math.sin(roll)
    for k in range(3):
        R[0, k] = c * Rp[k, 0] - s * Rp[k, 1]
        R[1, k] = s * Rp[k, 0] + c * Rp[k, 1]
        R[2, k] = Rp[k, 2]
    for k in range(3):
        t[k] = z * ray[k] / ray[2] - (R[k, 0] * p[0] + R[k, 1] * p[1] + R[k, 2] * p[2])


@njit(cache=True, error_model="numpy")
def _most_in_layer(name: Indices, layer: Indices, layers: int) -> int:
    count = np.zeros(layers, np.int64)
    for c in range(len(name)):
        if name[c] >= 0:
            count[layer[c]] += 1
    return count.max()


@njit(cache=True, error_model="numpy")
def _named(name: Indices) -> int:
    n = 0
    for c in range(len(name)):
        n += name[c] >= 0
    return n


@njit(cache=True, error_model="numpy")
def other_pose(
    name: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    axis: Array,
    survey_m2: Array,
    uv: Array,
    var: Array,
    like: Array,
    log_clutter: Array,
    R: Array,
    t: Array,
    Rp: Array,
    info: Array,
    q: Array,
    R2: Array,
    t2: Array,
) -> float:
    """The flipped pose `R2`, `t2` of the same names and its log evidence; hugely negative where there is but one."""
    m = len(name)
    H, L = np.empty((6, 6)), np.empty((6, 6))
    ps, n = np.empty((m, 3)), 0
    for c in range(m):
        if name[c] >= 0:
            ps[n] = p[c]
            n += 1
    R2[:], t2[:] = R, t
    flip(ps, n, R2, t2)
    e = evidence(name, lens, p, layer, axis, survey_m2, uv, var, like, log_clutter, R2, t2, Rp, info, q, 20, H, L)
    return -_HUGE if _turn(R, R2) < _SAME_TURN else e


@njit(cache=True, error_model="numpy")
def rivals(
    name: Indices,
    taken: Indices,
    lens: Array,
    p: Array,
    layer: Indices,
    axis: Array,
    survey_m2: Array,
    rank: Indices,
    uv: Array,
    var: Array,
    like: Array,
    log_clutter: Array,
    R: Array,
    t: Array,
    Rp: Array,
    info: Array,
    q: Array,
    without: Array,
    against: Array,
    better: Indices,
    R2: Array,
    t2: Array,
) -> float:
    """Hypotheses one relabelling away, each solved anew.

    A detection left out, with others added where they then fit; another detection for a light; another light for a
    detection; two lights exchanged. Fills `without` (M,), the log evidence that leaves a light's detection out;
    `against` (M,), the log mass of those that name a light otherwise; and the best of all, `better` (M,), `R2`, `t2`,
    whose log evidence it returns.
    """
    m, best = len(name), -_HUGE
    H, L, P, Hk = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    Rk, tk, R0, t0, trial = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3), name.copy()
    h, S = np.empty(14), np.empty(3)
    grown, held, work = name.copy(), taken.copy(), np.empty((3, 6, 6))
    without[:] = -_HUGE
    against[:] = -_HUGE
    for c in range(m):
        i = name[c]
        if i < 0:
            continue
        trial[c] = -1
        R0[:], t0[:] = R, t
        e = evidence(trial, lens, p, layer, axis, survey_m2, uv, var, like, log_clutter, R0, t0, Rp, info, q, 6, H, L)
        without[c] = e
        if e > best:
            best, better[:], R2[:], t2[:] = e, trial, R0, t0
        # without this name others may find their place
        grown[:], held[:], Rk[:], tk[:] = trial, taken, R0, t0
        grow(-1, grown, held, lens, p, layer, survey_m2, rank, uv, var, like, Rk, tk, Rp, info, q, work)
        if _named(grown) > _named(trial):
            e = evidence(
                grown, lens, p, layer, axis, survey_m2, uv, var, like, log_clutter, Rk, tk, Rp, info, q, 6, Hk, L
            )
            against[c] = _log_add(against[c], e)
            if e > best:
                best, better[:], R2[:], t2[:] = e, grown, Rk, tk
        e = without[c]
        usable = e > -_HUGE and not math.isnan(invert6(H, L, P))
        for c2 in range(m):
            if not usable or (c2 < c and name[c2] >= 0) or not light_row(lens, R0, t0, p[c2], h):
                continue
            _innovation(h, P, _survey_var(lens, R0, t0, p[c2], survey_m2[c2]), S)
            for k in range(len(uv)):
                # c2 == c: another detection for this light; c2 unnamed: this detection for that light; else: exchange
                if (c2 == c and (k == i or taken[k] >= 0)) or (c2 != c and k != i):
                    continue
                du, dv = uv[k, 0] - h[0], uv[k, 1] - h[1]
                s0, s1, s2 = S[0] + var[k], S[1], S[2] + var[k]
                nis = (s2 * du * du - 2.0 * s1 * du * dv + s0 * dv * dv) / (s0 * s2 - s1 * s1)
                if nis > 4.0 * q[GATE]:
                    continue
                j = name[c2]
                trial[c], trial[c2] = j if c2 != c else -1, k
                Rk[:], tk[:] = R0, t0
                e = evidence(
                    trial, lens, p, layer, axis, survey_m2, uv, var, like, log_clutter, Rk, tk, Rp, info, q, 8, Hk, L
                )
                against[c] = _log_add(against[c], e)
                if c2 != c and j >= 0:
                    against[c2] = _log_add(against[c2], e)
                if e > best:
                    best, better[:], R2[:], t2[:] = e, trial, Rk, tk
                trial[c] = -1
                if c2 != c:
                    trial[c2] = j
        trial[c] = i
    return best


@njit(cache=True, error_model="numpy")
def weigh(
    uv: Array, cov: Array, p_rear: Array, p_light: Array, is_rear: Indices, trust: float, like: Array, var: Array
) -> float:
    """Fill `like` (N, L), softened log likelihood ratios, and `var` (N,) px^2 per axis; the area px^2 of all spots."""
    low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
    layers = len(is_rear)
    for i in range(len(uv)):
        low_u, high_u = min(low_u, uv[i, 0]), max(high_u, uv[i, 0])
        low_v, high_v = min(low_v, uv[i, 1]), max(high_v, uv[i, 1])
        var[i] = 0.5 * (cov[i, 0, 0] + cov[i, 1, 1])
        lamp = 0.0 if math.isnan(p_light[i]) else math.log(min(max(2.0 * p_light[i], 0.05), 1.0))
        p = 0.5 if math.isnan(p_rear[i]) or layers == 1 else 0.5 + trust * (p_rear[i] - 0.5)
        for k in range(layers):
            like[i, k] = lamp + math.log(2.0 * (p if is_rear[k] == 1 or layers == 1 else 1.0 - p))
    return (high_u - low_u) * (high_v - low_v)

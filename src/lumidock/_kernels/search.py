"""The search for the most probable naming of detections without history.

Two detections named after two lights of a layer give a pose for the expected attitude; where the other lights of that
layer then have detections within their gates, a third one is named, and the naming grown.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lumidock._kernels.evidence import (
    BEND,
    FAR_M,
    GATE,
    HUGE,
    NEAR_M,
    PAIR_GATE,
    ROLL_GATE,
    Expected,
    Lights,
    Seen,
    evidence,
    fit,
    innovation,
    log_evidence,
    named,
    survey_var,
)
from lumidock._kernels.lens import invert6
from lumidock._kernels.pose import flip, light_row
from lumidock.datatypes import Array, Indices

SAME_TURN = 2e-3  # rad; closer solutions are one
_THIRDS, _ALL_THIRDS = 3, 24  # third lights tried for a pair; and where three are all there may be
_FOURTHS = 4  # fourth lights tried for each
_BRANCHES, _FIRSTS = 2, 48  # first lights of another layer tried, of so many looked at
_NEAR = 2.0  # gates within which a detection may still come to lie in its gate
_CLOSE = 10.0  # log evidence; a naming of one layer this far behind the best is still tried with the others


class Best(NamedTuple):
    """A naming (M,) and its pose, filled in place."""

    name: Indices
    R: Array
    t: Array


class Listed(NamedTuple):
    """K hypotheses, filled in place: `names` (K, M), log evidence `scores` (K,), poses `Rs` (K, 3, 3), `ts` (K, 3)."""

    names: Indices
    scores: Array
    Rs: Array
    ts: Array


class Goal(NamedTuple):
    """What a search still looks for.

    `bounds` (4,): the least lights of one layer, the least in all, the most named so far, less one, and what one layer
    must name at least. `budget` (1,) pairs that may still be tried. `best` (1,) log evidence so far.
    """

    bounds: Indices
    budget: Indices
    best: Array


class _View(NamedTuple):
    """The lights under a pose of which two pixels and the expected attitude are known.

    Pixel and Jacobian `rows` (M, 14), `S` (M, 3) covariance px^2 without that of a detection, `extra` (M,) px^2 the
    share of it that the pose has no part in, `there` (M,) which are to be found; `open` (3, 6) information of the
    prior; `R`, `t`, and `P` (6, 6).
    """

    rows: Array
    S: Array
    extra: Array
    there: np.ndarray
    open: Array
    R: Array
    t: Array
    P: Array
    work: Array


@njit(cache=True, error_model="numpy")
def search(
    lights: Lights,
    seen: Seen,
    expected: Expected,
    pairs: Indices,
    unseen: Indices,
    goal: Goal,
    count: int,
    listed: Listed,
) -> int:
    """Add the best hypotheses to the `count` of a list; returns how many there are then.

    `pairs` (S, 2) are lights of one layer, in order; `unseen` (S,) is the most lights of one layer that a hypothesis
    can name without naming any pair before that one. The search stops when what it has not seen cannot come within one
    light of the best, in all or in any one layer, so that it is exhaustive in what matters; or when its budget is
    spent, which then is negative. Of a pair of lights those detections come first that leave most others in place.
    """
    m, n = len(lights.p), len(seen.uv)
    layers = seen.like.shape[1]
    view = _View(
        np.empty((m, 14)),
        np.empty((m, 3)),
        np.empty(m),
        np.zeros(m, np.bool_),
        np.empty((3, 6)),
        np.empty((3, 3)),
        np.empty(3),
        np.empty((6, 6)),
        np.empty((3, 6, 6)),
    )
    _open_attitude(expected, view.open)
    by_u = np.argsort(seen.uv[:, 0])
    tries = np.empty((2 * n * n, 5))
    thirds = np.empty((_THIRDS if goal.bounds[0] > 3 else _ALL_THIRDS, 3))
    for s in range(len(pairs)):
        if unseen[s] < _wanted(goal, layers):
            break
        a, b = pairs[s]
        found = _pair_poses(a, b, lights, seen, expected, by_u, view, goal, tries)
        order = np.argsort(-tries[:found, 0], kind="mergesort")
        for o in order:
            if tries[o, 0] < max(_wanted(goal, layers) - 2, 1):
                break
            i, j, z, roll = int(tries[o, 1]), int(tries[o, 2]), tries[o, 3], tries[o, 4]
            count = _try_pair(a, b, i, j, z, roll, lights, seen, expected, by_u, view, thirds, goal, count, listed)
        if goal.budget[0] < 0:
            break
    H, L = view.work[0], view.work[1]
    for k in range(count):
        listed.scores[k] = evidence(listed.names[k], lights, seen, expected, listed.Rs[k], listed.ts[k], 6, H, L)
    return count


@njit(cache=True, error_model="numpy")
def _wanted(goal: Goal, layers: int) -> int:
    """How many lights of one layer a hypothesis must name to matter."""
    least, floor, most, in_layer = goal.bounds
    return max(least, in_layer, (max(most, floor) + layers - 1) // layers)


@njit(cache=True, error_model="numpy")
def _pair_poses(
    a: int,
    b: int,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    by_u: Indices,
    view: _View,
    goal: Goal,
    tries: Array,
) -> int:
    """All pairs of detections that lights `a` and `b` may have made.

    Fills rows of `tries`: how many other lights of the layer are in place, the two detections, depth of `a`, and roll.
    Pairs that leave too few are left out. Returns how many rows.
    """
    n, found, layers = len(seen.uv), 0, seen.like.shape[1]
    d, sols = np.empty(3), np.empty((2, 2))
    for k in range(3):  # R_cam_dock of the prior is Rp^T
        d[k] = 0.0
        for o in range(3):
            d[k] += expected.Rp[o, k] * (lights.p[b, o] - lights.p[a, o])
    least = max(_wanted(goal, layers) - 2, 1)
    for i in range(n):
        for j in range(n):
            if i == j or not (seen.ray[i, 2] > 0.0 and seen.ray[j, 2] > 0.0):
                continue
            for sol in range(_pair_pose(d, seen.ray[i], seen.ray[j], expected.q, sols)):
                goal.budget[0] -= 1
                if goal.budget[0] < 0:
                    return found
                _know_pair(a, b, i, j, sols[sol, 0], sols[sol, 1], lights, seen, expected, view)
                support = _in_place(a, b, i, j, least, lights, seen, expected, by_u, view)
                if support >= least:
                    tries[found, 0], tries[found, 1], tries[found, 2] = support, i, j
                    tries[found, 3], tries[found, 4] = sols[sol, 0], sols[sol, 1]
                    found += 1
    return found


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
def _know_pair(
    a: int, b: int, i: int, j: int, z: float, roll: float, lights: Lights, seen: Seen, expected: Expected, view: _View
) -> None:
    """Pose and covariance, in `view`, of two named lights and the expected attitude turned by `roll`."""
    R, t = view.R, view.t
    _pose_of(expected.Rp, roll, z, seen.ray[i], lights.p[a], R, t)
    H, h = view.work[0], view.rows[a]
    H[:3] = 0.0
    H[3:] = view.open
    for k in range(2):
        c, d = (a, i) if k == 0 else (b, j)
        if light_row(lights.lens, R, t, lights.p[c], h):
            w = 1.0 / (seen.var[d] + survey_var(lights.lens, R, t, lights.p[c], lights.survey_m2[c]))
            for m in range(6):
                for o in range(m + 1):
                    H[m, o] += w * (h[2 + m] * h[2 + o] + h[8 + m] * h[8 + o])
    invert6(H, view.work[1], view.P)


@njit(cache=True, error_model="numpy")
def _open_attitude(expected: Expected, open_: Array) -> None:
    """Information (3, 6) that the attitude prior has of a pose; of rotation, the last three columns.

    At the expected attitude its Jacobian is, whatever the roll, -y, x and -z of `cam` in dock axes.
    """
    open_[:] = 0.0
    for m in range(3):
        axis = 1 - m if m < 2 else 2
        for k in range(3):
            for o in range(3):
                open_[k, 3 + o] += expected.info[m] * expected.Rp[k, axis] * expected.Rp[o, axis]


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
def _in_place(
    a: int,
    b: int,
    i: int,
    j: int,
    least: int,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    by_u: Indices,
    view: _View,
) -> int:
    """How many other lights of the layer have a detection in their gate; fills `view` with where they are.

    Ends early where `least` can no longer be reached. One function with its arrays at hand: it is half of all work.
    """
    lens, p, layer, uv, var = lights.lens, lights.p, lights.layer, seen.uv, seen.var
    rows, there, R, t, P, survey_m2 = view.rows, view.there, view.R, view.t, view.P, lights.survey_m2
    gate, bend = expected.q[PAIR_GATE], expected.q[BEND]
    mu, mv = 0.5 * (uv[i, 0] + uv[j, 0]), 0.5 * (uv[i, 1] + uv[j, 1])
    support, left = 0, -2
    for c in range(len(p)):
        left += layer[c] == layer[a]
    for c in range(len(p)):
        there[c] = False
        if c == a or layer[c] != layer[a] or c == b:  # noqa: SIM109 - slow in numba
            continue
        if support + left < least:
            break
        left -= 1
        h, S = rows[c], view.S[c]
        if not light_row(lens, R, t, p[c], h):
            continue
        there[c] = True
        du, dv = h[0] - mu, h[1] - mv
        view.extra[c] = survey_var(lens, R, t, p[c], survey_m2[c]) + bend * (du * du + dv * dv)
        innovation(h, P, view.extra[c], S)
        support += _occupied(h[0], h[1], S, i, j, -1, uv, var, seen.loosest, by_u, gate)
    return support


@njit(cache=True, error_model="numpy")
def _thirds(i: int, j: int, after: int, lights: Lights, seen: Seen, gate: float, view: _View, out: Array) -> int:
    """Third lights, of those expected that rank after `after`, with detections in their gates, cheapest first.

    Fills rows of `out` (K, 3) with NIS + log det S - 2 log likelihood, light and detection; returns how many.
    """
    found, uv, var, like = 0, seen.uv, seen.var, seen.like
    for c in range(len(lights.p)):
        if not view.there[c] or lights.rank[c] <= after:
            continue
        u, v, S, layer = view.rows[c, 0], view.rows[c, 1], view.S[c], lights.layer[c]
        for o in range(len(uv)):
            nis, log_det = _nis(uv[o, 0] - u, uv[o, 1] - v, S, var[o])
            if nis <= gate and o != i and o != j:
                found = _insert(out, found, nis + log_det - 2.0 * like[o, layer], c, o)
    return found


@njit(cache=True, error_model="numpy")
def _nis(du: float, dv: float, S: Array, var: float) -> tuple[float, float]:
    """Normalised innovation squared of a detection (du, dv) px off, and the log determinant of its covariance."""
    s0, s1, s2 = S[0] + var, S[1], S[2] + var
    det = s0 * s2 - s1 * s1
    return (s2 * du * du - 2.0 * s1 * du * dv + s0 * dv * dv) / det, math.log(det)


@njit(cache=True, error_model="numpy")
def _first(uv: Array, by_u: Indices, u: float) -> int:
    """Place in the order `by_u` of the first detection whose column is at least `u`."""
    low, high = 0, len(by_u)
    while low < high:
        middle = (low + high) // 2
        if uv[by_u[middle], 0] < u:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy")
def _insert(out: Array, found: int, price: float, c: int, i: int) -> int:
    """Put a row into `out` (K, 3), cheapest first, unless all of a full one are cheaper; returns how many rows."""
    if found < len(out):
        found += 1
    elif price >= out[found - 1, 0]:
        return found
    at = found - 1
    while at > 0 and out[at - 1, 0] > price:
        out[at] = out[at - 1]
        at -= 1
    out[at, 0], out[at, 1], out[at, 2] = price, c, i
    return found


@njit(cache=True, error_model="numpy")
def _try_pair(
    a: int,
    b: int,
    i: int,
    j: int,
    z: float,
    roll: float,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    by_u: Indices,
    view: _View,
    thirds: Array,
    goal: Goal,
    count: int,
    listed: Listed,
) -> int:
    """Grow namings from a pair and a third light, and list them. Each triple is tried once: the third ranks last."""
    layers = seen.like.shape[1]
    name, taken = np.empty(len(lights.p), np.int64), np.empty(len(seen.uv), np.int64)
    _know_pair(a, b, i, j, z, roll, lights, seen, expected, view)
    _in_place(a, b, i, j, 0, lights, seen, expected, by_u, view)
    after = max(lights.rank[a], lights.rank[b])
    found = _thirds(i, j, after, lights, seen, expected.q[PAIR_GATE], view, thirds)
    for k in range(found):
        c, o = int(thirds[k, 1]), int(thirds[k, 2])
        if _known(listed.names, count, a, i, b, j, c, o):
            continue
        wanted = _wanted(goal, layers)
        if wanted > 3 and wanted > 3 + _support(c, o, i, j, lights, seen, by_u, view, expected.q[PAIR_GATE]):
            continue
        name[:] = -1
        taken[:] = -1
        name[a], name[b], name[c], taken[i], taken[j], taken[o] = i, j, o, a, b, c
        count = _try_three(name, taken, lights.layer[a], lights, seen, expected, view, goal, count, listed)
    return count


@njit(cache=True, error_model="numpy")
def _try_three(
    three: Indices,
    held: Indices,
    layer: int,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    view: _View,
    goal: Goal,
    count: int,
    listed: Listed,
) -> int:
    """Grow namings from three, and list them: the cheapest fourth light first, then others that it led away from."""
    layers, work, fourths = seen.like.shape[1], view.work, np.empty((_FOURTHS, 3))
    R3, t3 = view.R.copy(), view.t.copy()
    fit(three, lights, seen, R3, t3, expected.Rp, expected.info, 6, work[0], work[1])
    if math.isnan(invert6(work[0], work[1], work[2])):
        return count
    found, near = _best_lights(layer, three, held, lights, seen, R3, t3, work[2], expected.q[GATE], fourths)
    first = three
    for k in range(max(found, 1)):
        if 3 + near < _wanted(goal, layers):
            break
        name, taken, R, t = three.copy(), held.copy(), R3.copy(), t3.copy()
        if found:
            c, o = int(fourths[k, 1]), int(fourths[k, 2])
            if first[c] == o:
                continue
            name[c], taken[o] = o, c
        e = _grown(layer, name, taken, lights, seen, expected, R, t, work, goal)
        if k == 0:
            first = name
        if e > -HUGE and named(name) >= goal.bounds[1]:
            count = _store(name, e, R, t, count, listed)
            _aim(name, e, lights.layer, layers, goal)
    return count


@njit(cache=True, error_model="numpy")
def _aim(name: Indices, e: float, layer: Indices, layers: int, goal: Goal) -> None:
    """Raise what is still looked for to what a new best hypothesis names."""
    if e <= goal.best[0]:
        return
    goal.best[0] = e
    if e > 0.0:
        goal.bounds[2] = max(goal.bounds[2], named(name) - 1)
        goal.bounds[3] = max(goal.bounds[3], _most_in_layer(name, layer, layers) - 1)


@njit(cache=True, error_model="numpy")
def _grown(
    layer: int,
    name: Indices,
    taken: Indices,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    R: Array,
    t: Array,
    work: Array,
    goal: Goal,
) -> float:
    """Log evidence of a naming of one layer, grown in place: first within the layer, then over all."""
    least = _wanted(goal, seen.like.shape[1])
    fitted = grow(layer, name, taken, lights, seen, expected, R, t, work, least)
    e = log_evidence(name, lights, seen, R, t, expected.info, expected.q, fitted)
    if e <= -HUGE or named(name) < goal.bounds[0]:
        return -HUGE
    if e > goal.best[0] - _CLOSE or (e > 0.0 and named(name) > 3):
        e = _others(name, taken, lights, seen, expected, R, t, work)
    return e


@njit(cache=True, error_model="numpy")
def grow(
    allowed: int,
    name: Indices,
    taken: Indices,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    R: Array,
    t: Array,
    work: Array,
    least: int,
) -> tuple[float, float, float]:
    """Name light after light of layer `allowed` (-1: any), the cheapest first, solving the pose anew after each.

    Works in place; returns what `fit` does, NaN once `least` named lights are out of reach. `work` (3, 6, 6).
    """
    H, L, P = work[0], work[1], work[2]
    out = np.empty((1, 3))
    fitted = fit(name, lights, seen, R, t, expected.Rp, expected.info, 6, H, L)
    for _ in range(len(name)):
        if math.isnan(fitted[1]) or math.isnan(invert6(H, L, P)):
            return np.nan, np.nan, 0.0
        found, near = _best_lights(allowed, name, taken, lights, seen, R, t, P, expected.q[GATE], out)
        if named(name) + near < least:
            return np.nan, np.nan, 0.0
        if not found:
            break
        c, i = int(out[0, 1]), int(out[0, 2])
        name[c], taken[i] = i, c
        fitted = fit(name, lights, seen, R, t, expected.Rp, expected.info, 4, H, L)
    return fitted


@njit(cache=True, error_model="numpy")
def _best_lights(
    allowed: int,
    name: Indices,
    taken: Indices,
    lights: Lights,
    seen: Seen,
    R: Array,
    t: Array,
    P: Array,
    gate: float,
    out: Array,
) -> tuple[int, int]:
    """The unnamed lights of layer `allowed` (-1: any) with a free detection inside their gate, cheapest first.

    Fills rows of `out` (K, 3) with NIS + log det S - 2 log likelihood, light and detection; returns how many, and how
    many lights have a detection not far outside their gate.
    """
    h, S, found, near = np.empty(14), np.empty(3), 0, 0
    uv, var, like = seen.uv, seen.var, seen.like
    for c in range(len(name)):
        layer = lights.layer[c]
        if name[c] >= 0 or (allowed >= 0 and layer != allowed):
            continue
        if not light_row(lights.lens, R, t, lights.p[c], h):
            continue
        innovation(h, P, survey_var(lights.lens, R, t, lights.p[c], lights.survey_m2[c]), S)
        least = HUGE
        for i in range(len(uv)):
            if taken[i] >= 0:
                continue
            nis, log_det = _nis(uv[i, 0] - h[0], uv[i, 1] - h[1], S, var[i])
            least = min(least, nis)
            if nis <= gate:
                found = _insert(out, found, nis + log_det - 2.0 * like[i, layer], c, i)
        near += least <= _NEAR * gate
    return found, near


@njit(cache=True, error_model="numpy")
def _support(
    c: int, o: int, i: int, j: int, lights: Lights, seen: Seen, by_u: Indices, view: _View, gate: float
) -> int:
    """How many other expected lights find a detection in place once `o` is named after light `c`.

    By one linear update of the pose and its covariance.
    """
    P2, gain, shift, S, row = np.empty((6, 6)), np.empty((6, 2)), np.empty(6), np.empty(3), view.rows[c]
    S[0], S[1], S[2] = view.S[c, 0] + seen.var[o], view.S[c, 1], view.S[c, 2] + seen.var[o]
    _condition(row, view.P, S, seen.uv[o, 0] - row[0], seen.uv[o, 1] - row[1], P2, gain, shift)
    support = 0
    for c2 in range(len(lights.p)):
        if c2 == c or not view.there[c2]:
            continue
        innovation(view.rows[c2], P2, view.extra[c2], S)
        u, v = view.rows[c2, 0], view.rows[c2, 1]
        for k in range(6):
            u += view.rows[c2, 2 + k] * shift[k]
            v += view.rows[c2, 8 + k] * shift[k]
        support += _occupied(u, v, S, i, j, o, seen.uv, seen.var, seen.loosest, by_u, gate)
    return support


@njit(cache=True, error_model="numpy")
def _occupied(
    u: float,
    v: float,
    S: Array,
    i: int,
    j: int,
    o: int,
    uv: Array,
    var: Array,
    loosest: float,
    by_u: Indices,
    gate: float,
) -> bool:
    """Whether a detection other than `i`, `j` and `o` lies in the gate of covariance `S` (3,) about a pixel."""
    reach = math.sqrt(gate * (S[0] + loosest))
    for k in range(_first(uv, by_u, u - reach), len(by_u)):
        d = by_u[k]
        du, dv = uv[d, 0] - u, uv[d, 1] - v
        if du > reach:
            return False
        s0, s1, s2 = S[0] + var[d], S[1], S[2] + var[d]
        inside = s2 * du * du - 2.0 * s1 * du * dv + s0 * dv * dv < gate * (s0 * s2 - s1 * s1)
        if inside and d != i and d != j and d != o:
            return True
    return False


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
def _others(
    name: Indices,
    taken: Indices,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    R: Array,
    t: Array,
    work: Array,
) -> float:
    """Extend a hypothesis of one layer to all, in place, over both poses of the plane and the first light beyond it.

    Growing greedily picks wrong where the tilt is open, so several first lights are tried. Returns the log evidence.
    """
    best_name, best_R, best_t, best = name.copy(), R.copy(), t.copy(), -HUGE
    out, tops = np.empty((_FIRSTS, 3)), np.empty((_BRANCHES, 2))
    H, L, P = work[0], work[1], work[2]
    info, q = expected.info, expected.q
    for mode in range(2):
        Rm, tm = R.copy(), t.copy()
        if mode == 1:
            _flipped(name, lights.p, Rm, tm)
        fitted = fit(name, lights, seen, Rm, tm, expected.Rp, info, 12, H, L)
        e = log_evidence(name, lights, seen, Rm, tm, info, q, fitted)
        if mode == 1 and (e < best - 30.0 or turn(Rm, R) < SAME_TURN):
            break
        if mode == 0:
            R[:], t[:] = Rm, tm
        if e > best:
            best, best_name[:], best_R[:], best_t[:] = e, name, Rm, tm
        if e <= -HUGE or math.isnan(invert6(H, L, P)):
            continue
        found, _ = _best_lights(-1, name, taken, lights, seen, Rm, tm, P, q[GATE], out)
        kept = _most_supported(out, found, name, taken, lights, seen, Rm, tm, P, q[GATE], tops)
        for k in range(kept):
            trial, held, Rk, tk = name.copy(), taken.copy(), Rm.copy(), tm.copy()
            c, i = int(out[int(tops[k, 1]), 1]), int(out[int(tops[k, 1]), 2])
            trial[c], held[i] = i, c
            fitted = grow(-1, trial, held, lights, seen, expected, Rk, tk, work, 0)
            e = log_evidence(trial, lights, seen, Rk, tk, info, q, fitted)
            if e > best:
                best, best_name[:], best_R[:], best_t[:] = e, trial, Rk, tk
    name[:], R[:], t[:] = best_name, best_R, best_t
    return best


@njit(cache=True, error_model="numpy")
def _flipped(name: Indices, p: Array, R: Array, t: Array) -> None:
    """Turn a pose, in place, into the other one that its named lights fit nearly as well."""
    ps, n = np.empty((len(name), 3)), 0
    for c in range(len(name)):
        if name[c] >= 0:
            ps[n] = p[c]
            n += 1
    flip(ps, n, R, t)


@njit(cache=True, error_model="numpy")
def _most_supported(
    out: Array,
    found: int,
    name: Indices,
    taken: Indices,
    lights: Lights,
    seen: Seen,
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
        support = _beyond(c, i, name, taken, lights, seen, R, t, P, 2.0 * gate)
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
def _beyond(
    c: int, i: int, name: Indices, taken: Indices, lights: Lights, seen: Seen, R: Array, t: Array, P: Array, gate: float
) -> int:
    """How many other lights of the layer of `c` find a free detection once `i` is named after `c`."""
    P2, gain, shift, S, h = np.empty((6, 6)), np.empty((6, 2)), np.empty(6), np.empty(3), np.empty(14)
    light_row(lights.lens, R, t, lights.p[c], h)
    innovation(h, P, seen.var[i] + survey_var(lights.lens, R, t, lights.p[c], lights.survey_m2[c]), S)
    _condition(h, P, S, seen.uv[i, 0] - h[0], seen.uv[i, 1] - h[1], P2, gain, shift)
    support = 0
    for c2 in range(len(name)):
        if c2 == c or name[c2] >= 0 or lights.layer[c2] != lights.layer[c]:
            continue
        if not light_row(lights.lens, R, t, lights.p[c2], h):
            continue
        innovation(h, P2, 1.0 + survey_var(lights.lens, R, t, lights.p[c2], lights.survey_m2[c2]), S)
        u, v = h[0], h[1]
        for k in range(6):
            u += h[2 + k] * shift[k]
            v += h[8 + k] * shift[k]
        det = gate * (S[0] * S[2] - S[1] * S[1])
        for o in range(len(seen.uv)):
            du, dv = seen.uv[o, 0] - u, seen.uv[o, 1] - v
            if o != i and taken[o] < 0 and S[2] * du * du - 2.0 * S[1] * du * dv + S[0] * dv * dv < det:
                support += 1
                break
    return support


@njit(cache=True, error_model="numpy")
def turn(Ra: Array, Rb: Array) -> float:
    """Angle rad between two rotations, small or not."""
    s = 0.0
    for i in range(3):
        for j in range(3):
            s += (Ra[i, j] - Rb[i, j]) ** 2
    return math.sqrt(0.5 * s)


@njit(cache=True, error_model="numpy")
def _known(names: Indices, count: int, a: int, i: int, b: int, j: int, c: int, o: int) -> bool:
    """Whether a listed hypothesis gives light `a` detection `i`, `b` `j` and `c` `o`."""
    for k in range(count):  # noqa: SIM110 - numba compiles no generator
        if names[k, a] == i and names[k, b] == j and names[k, c] == o:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _store(name: Indices, e: float, R: Array, t: Array, count: int, listed: Listed) -> int:
    """List a hypothesis unless it is known or worse than all of a full list; returns how many there are."""
    scores = listed.scores
    for k in range(count):
        if (listed.names[k] == name).all():
            if e > scores[k]:
                scores[k], listed.Rs[k], listed.ts[k] = e, R, t
            return count
    at = count
    if count == len(scores):
        at = int(np.argmin(scores))
        if scores[at] >= e:
            return count
    listed.names[at], scores[at], listed.Rs[at], listed.ts[at] = name, e, R, t
    return max(count, at + 1)


@njit(cache=True, error_model="numpy")
def _most_in_layer(name: Indices, layer: Indices, layers: int) -> int:
    count = np.zeros(layers, np.int64)
    for c in range(len(name)):
        if name[c] >= 0:
            count[layer[c]] += 1
    return count.max()

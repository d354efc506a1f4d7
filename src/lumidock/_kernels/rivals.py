"""Hypotheses next to a given one: its other pose, and all namings one relabelling away."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lumidock._kernels.evidence import (
    GATE,
    HUGE,
    STEADY,
    Expected,
    Lights,
    Seen,
    evidence,
    fit,
    innovation,
    log_add,
    log_evidence,
    named,
    survey_var,
)
from lumidock._kernels.lens import invert6
from lumidock._kernels.pose import flip, light_row
from lumidock._kernels.search import SAME_TURN, Best, grow, turn
from lumidock.datatypes import Array, Indices


@njit(cache=True, error_model="numpy")
def other_pose(
    name: Indices,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    level: bool,
    R: Array,
    t: Array,
    R2: Array,
    t2: Array,
) -> float:
    """Another pose `R2`, `t2` that fits the same names, and its log evidence; hugely negative where there is but one.

    Found from the flipped pose, or, with `level`, from the expected attitude: lights off the axis leave two solutions
    whose tilts are not opposite. Where the steady part of the prior leads back to the first pose, it counts there.
    """
    H, L = np.empty((6, 6)), np.empty((6, 6))
    ps, n = np.empty((len(name), 3)), 0
    for c in range(len(name)):
        if name[c] >= 0:
            ps[n] = lights.p[c]
            n += 1
    R2[:], t2[:] = R, t
    if level:
        _levelled(ps, n, expected.Rp, R2, t2)
    else:
        flip(ps, n, R2, t2)
    q = expected.q
    fitted = fit(name, lights, seen, R2, t2, expected.Rp, expected.info, 20, H, L)
    wide = log_evidence(name, lights, seen, R2, t2, expected.info, q, fitted)
    if wide <= -HUGE or turn(R, R2) < SAME_TURN:
        return -HUGE
    if q[STEADY] <= 0.0:
        return wide
    Rn, tn = R2.copy(), t2.copy()
    fitted = fit(name, lights, seen, Rn, tn, expected.Rp, expected.steady, 20, H, L)
    narrow = log_evidence(name, lights, seen, Rn, tn, expected.steady, q, fitted) + math.log(q[STEADY])
    wide += math.log(1.0 - q[STEADY])
    return log_add(wide, narrow) if turn(R, Rn) > turn(R2, Rn) else wide


@njit(cache=True, error_model="numpy")
def _levelled(p: Array, n: int, Rp: Array, R: Array, t: Array) -> None:
    """Turn a pose, in place, to the expected attitude with its own roll, about the centre of lights `p` (n, 3)."""
    sine, cosine = 0.0, 0.0
    for k in range(3):
        sine += R[1, k] * Rp[k, 0] - R[0, k] * Rp[k, 1]
        cosine += R[0, k] * Rp[k, 0] + R[1, k] * Rp[k, 1]
    norm = max(math.hypot(sine, cosine), 1e-12)
    s, c = sine / norm, cosine / norm
    centre, q = np.zeros(3), t.copy()
    for m in range(n):
        centre += p[m] / n
    for i in range(3):
        for k in range(3):
            q[i] += R[i, k] * centre[k]
    for k in range(3):
        R[0, k] = c * Rp[k, 0] - s * Rp[k, 1]
        R[1, k] = s * Rp[k, 0] + c * Rp[k, 1]
        R[2, k] = Rp[k, 2]
    for i in range(3):
        t[i] = q[i]
        for k in range(3):
            t[i] -= R[i, k] * centre[k]


@njit(cache=True, error_model="numpy")
def rivals(
    name: Indices,
    taken: Indices,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    R: Array,
    t: Array,
    without: Array,
    against: Array,
    better: Best,
) -> float:
    """Hypotheses one relabelling away, each solved anew.

    A detection left out, with others added where they then fit; another detection for a light; another light for a
    detection; two lights exchanged. Fills `without` (M,), the log evidence that leaves a light's detection out;
    `against` (M,), the log mass of those that name a light otherwise; and the best of all, `better`, whose log
    evidence it returns.
    """
    best = -HUGE
    H, L, P = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    R0, t0, trial = np.empty((3, 3)), np.empty(3), name.copy()
    without[:] = -HUGE
    against[:] = -HUGE
    for c in range(len(name)):
        if name[c] < 0:
            continue
        trial[c] = -1
        R0[:], t0[:] = R, t
        e = evidence(trial, lights, seen, expected, R0, t0, 6, H, L)
        without[c] = e
        best = _keep(e, best, trial, R0, t0, better)
        best = _regrown(c, trial, taken, lights, seen, expected, R0, t0, against, best, better)
        if e > -HUGE and not math.isnan(invert6(H, L, P)):
            best = _exchanged(c, name, trial, taken, lights, seen, expected, R0, t0, P, against, best, better)
        trial[c] = name[c]
    return best


@njit(cache=True, error_model="numpy")
def _keep(e: float, best: float, name: Indices, R: Array, t: Array, better: Best) -> float:
    """Remember a hypothesis that beats the best."""
    if e > best:
        better.name[:], better.R[:], better.t[:] = name, R, t
    return max(e, best)


@njit(cache=True, error_model="numpy")
def _regrown(
    c: int,
    trial: Indices,
    taken: Indices,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    R0: Array,
    t0: Array,
    against: Array,
    best: float,
    better: Best,
) -> float:
    """Without the name of light `c` others may find their place."""
    H, L = np.empty((6, 6)), np.empty((6, 6))
    grown, held, R, t = trial.copy(), taken.copy(), R0.copy(), t0.copy()
    grow(-1, grown, held, lights, seen, expected, R, t, np.empty((3, 6, 6)), 0)
    if named(grown) <= named(trial):
        return best
    e = evidence(grown, lights, seen, expected, R, t, 6, H, L)
    against[c] = log_add(against[c], e)
    return _keep(e, best, grown, R, t, better)


@njit(cache=True, error_model="numpy")
def _exchanged(
    c: int,
    name: Indices,
    trial: Indices,
    taken: Indices,
    lights: Lights,
    seen: Seen,
    expected: Expected,
    R0: Array,
    t0: Array,
    P: Array,
    against: Array,
    best: float,
    better: Best,
) -> float:
    """Another detection for light `c`; its detection for an unnamed light; or exchanged with that of a later light."""
    i, h, S = name[c], np.empty(14), np.empty(3)
    H, L = np.empty((6, 6)), np.empty((6, 6))
    R, t = np.empty((3, 3)), np.empty(3)
    for c2 in range(len(name)):
        if (c2 < c and name[c2] >= 0) or not light_row(lights.lens, R0, t0, lights.p[c2], h):
            continue
        innovation(h, P, survey_var(lights.lens, R0, t0, lights.p[c2], lights.survey_m2[c2]), S)
        for k in range(len(seen.uv)):
            if (c2 == c and (k == i or taken[k] >= 0)) or (c2 != c and k != i):
                continue
            du, dv = seen.uv[k, 0] - h[0], seen.uv[k, 1] - h[1]
            s0, s1, s2 = S[0] + seen.var[k], S[1], S[2] + seen.var[k]
            nis = (s2 * du * du - 2.0 * s1 * du * dv + s0 * dv * dv) / (s0 * s2 - s1 * s1)
            if nis > 4.0 * expected.q[GATE]:
                continue
            j = name[c2]
            trial[c], trial[c2] = j if c2 != c else -1, k
            R[:], t[:] = R0, t0
            e = evidence(trial, lights, seen, expected, R, t, 8, H, L)
            against[c] = log_add(against[c], e)
            if c2 != c and j >= 0:
                against[c2] = log_add(against[c2], e)
            best = _keep(e, best, trial, R, t, better)
            trial[c] = -1
            if c2 != c:
                trial[c2] = j
    return best

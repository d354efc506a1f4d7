"""Hypotheses next to a given one: its other pose, and all namings one relabelling away."""

from __future__ import annotations

import math

import numpy as np

from lumidock._kernels import constant
from lumidock._kernels.compiling import entry, part
from lumidock._kernels.lens import invert6
from lumidock._kernels.matching.evidence import (
    GATE,
    HUGE,
    STEADY,
    STEPS,
    Naming,
    Scene,
    copied,
    evidence,
    innovation,
    keep,
    log_add,
    named,
    named_points,
    put,
    solved,
    survey_var,
)
from lumidock._kernels.matching.gates import ANY, nis
from lumidock._kernels.matching.grow import NONE, grow
from lumidock._kernels.pose import SAME_TURN, flip, light_row, turn
from lumidock.datatypes import Array, Indices

_STEPS_OTHER, _STEPS_EXCHANGED = constant(20), constant(8)
_FAR_GATES = 4.0  # gates within which another name is tried


@entry
def other_pose(one: Naming, scene: Scene, level: bool, other: Naming) -> float:
    """Fill `other`, another pose that fits the same names; its log evidence, hugely negative where there is but one.

    Found from the flipped pose, or, with `level`, from the expected attitude: lights off the axis leave two solutions
    whose tilts are not opposite. Where the steady part of the prior leads back to the first pose, it counts there.
    """
    H, L = np.empty((6, 6)), np.empty((6, 6))
    p, steady = named_points(one.name, scene.p), scene.q[STEADY]
    put(other, one)
    if level:
        _levelled(p, scene.Rp, other.R, other.t)
    else:
        flip(p, other.R, other.t)
    wide = solved(other, scene, scene.info, _STEPS_OTHER, H, L)
    if wide <= -HUGE or turn(one.R, other.R) < SAME_TURN:
        return -HUGE
    if steady <= 0.0:
        return wide
    held = copied(other)
    narrow = solved(held, scene, scene.steady, _STEPS_OTHER, H, L) + math.log(steady)
    wide += math.log(1.0 - steady)
    return log_add(wide, narrow) if turn(one.R, held.R) > turn(other.R, held.R) else wide


@part
def _levelled(p: Array, Rp: Array, R: Array, t: Array) -> None:
    """Turn a pose, in place, to the expected attitude with its own roll, about the centre of lights `p` (N, 3)."""
    sine, cosine = 0.0, 0.0
    for k in range(3):
        sine += R[1, k] * Rp[k, 0] - R[0, k] * Rp[k, 1]
        cosine += R[0, k] * Rp[k, 0] + R[1, k] * Rp[k, 1]
    norm = max(math.hypot(sine, cosine), 1e-12)
    s, c = sine / norm, cosine / norm
    centre, q = np.zeros(3), t.copy()
    for m in range(len(p)):
        for k in range(3):
            centre[k] += p[m, k] / len(p)
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


@entry
def rivals(one: Naming, taken: Indices, scene: Scene, without: Array, against: Array, better: Naming) -> float:
    """Hypotheses one relabelling away, each solved anew.

    A detection left out, with others added where they then fit; another detection for a light; another light for a
    detection; two lights exchanged. Fills `without` (M,), the log evidence that leaves a light's detection out;
    `against` (M,), the log mass of those that name a light otherwise; and the best of all, `better`, whose log
    evidence it returns.
    """
    best = -HUGE
    H, L, P = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    for c in range(len(one.name)):
        without[c] = against[c] = -HUGE
    for c in range(len(one.name)):
        if one.name[c] < 0:
            continue
        less = copied(one)
        less.name[c] = -1
        without[c] = evidence(less, scene, STEPS, H, L)
        best = keep(without[c], best, less, better)
        best = _regrown(c, less, taken, scene, against, best, better)
        if without[c] > -HUGE and not math.isnan(invert6(H, L, P)):
            best = _exchanged(c, one.name, less, taken, scene, P, against, best, better)
    return best


@part
def _regrown(c: int, less: Naming, taken: Indices, scene: Scene, against: Array, best: float, better: Naming) -> float:
    """Without the name of light `c` others may find their place."""
    grown, H, L = copied(less), np.empty((6, 6)), np.empty((6, 6))
    grow(ANY, grown, taken.copy(), scene, NONE)
    if named(grown.name) <= named(less.name):
        return best
    e = evidence(grown, scene, STEPS, H, L)
    against[c] = log_add(against[c], e)
    return keep(e, best, grown, better)


@part
def _exchanged(
    c: int,
    name: Indices,
    less: Naming,
    taken: Indices,
    scene: Scene,
    P: Array,
    against: Array,
    best: float,
    better: Naming,
) -> float:
    """Another detection for light `c`; its detection for an unnamed light; or exchanged with that of a later light.

    `name` (M,) are all names; `less` is without that of `c`, its pose of covariance `P`.
    """
    gate = _FAR_GATES * scene.q[GATE]
    i, h, S = name[c], np.empty(14), np.empty(3)
    H, L = np.empty((6, 6)), np.empty((6, 6))
    for c2 in range(len(name)):
        if (c2 < c and name[c2] >= 0) or not light_row(scene.lens, less.R, less.t, scene.p[c2], h):
            continue
        innovation(h, P, survey_var(scene.lens, less.R, less.t, scene.p[c2], scene.survey_m2[c2]), S)
        for k in range(len(scene.uv)):
            if (c2 == c and (k == i or taken[k] >= 0)) or (c2 != c and k != i):
                continue
            if nis(scene.uv[k, 0] - h[0], scene.uv[k, 1] - h[1], S, scene.var[k])[0] > gate:
                continue
            one, j = copied(less), name[c2]
            one.name[c], one.name[c2] = j if c2 != c else -1, k
            e = evidence(one, scene, _STEPS_EXCHANGED, H, L)
            against[c] = log_add(against[c], e)
            if c2 != c and j >= 0:
                against[c2] = log_add(against[c2], e)
            best = keep(e, best, one, better)
    return best

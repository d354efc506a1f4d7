"""Hypotheses next to a given one: its other pose, and all associations one relabelling away."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.lens import invert6
from lumidock._kernels.matching.evidence import (
    HUGE,
    STEPS,
    Candidate,
    Problem,
    assigned_points,
    copied,
    evidence,
    innovation,
    keep,
    log_add,
    n_assigned,
    put,
    solved,
    survey_var,
)
from lumidock._kernels.matching.gates import ANY, nis
from lumidock._kernels.matching.grow import NONE, grow
from lumidock._kernels.pose import SAME_TURN, flip, light_row, turn
from lumidock.datatypes import Array, Indices

_STEPS_OTHER, _STEPS_EXCHANGED = 20, 8
_FAR_GATES = 4.0  # gates within which another assignment is tried


class Doubt(NamedTuple):
    """What speaks against each assigned light of a hypothesis.

    `without` (M,): log evidence with its detection left out as clutter. `against` (M,): log of the summed evidence of
    the relabellings that give the light another detection, or none, or its detection to another light.
    """

    without: Array
    against: Array


@entry
def other_pose(one: Candidate, problem: Problem, level: bool, other: Candidate) -> float:
    """Fill `other`, another pose that fits the same assignment; its log evidence, hugely negative where there is none.

    Found from the flipped pose, or, with `level`, from the expected attitude: lights off the axis leave two solutions
    whose tilts are not opposite. Where the steady part of the prior leads back to the first pose, it counts there.
    """
    H, L = np.empty((6, 6)), np.empty((6, 6))
    p, steady = assigned_points(one.assignment, problem.p), problem.rules.steady
    put(other, one)
    if level:
        _levelled(p, problem.Rp, other.R, other.t)
    else:
        flip(p, other.R, other.t)
    wide = solved(other, problem, problem.info, _STEPS_OTHER, H, L)
    if wide <= -HUGE or turn(one.R, other.R) < SAME_TURN:
        return -HUGE
    if steady <= 0.0:
        return wide
    held = copied(other)
    narrow = solved(held, problem, problem.steady, _STEPS_OTHER, H, L) + math.log(steady)
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
def rivals(one: Candidate, taken: Indices, problem: Problem, doubt: Doubt, better: Candidate) -> float:
    """Hypotheses one relabelling away, each solved anew.

    A detection left out, with others added where they then fit; another detection for a light; another light for a
    detection; two lights exchanged. Fills `doubt`, and the best of all, `better`, whose log evidence it returns.
    """
    best, without, against = -HUGE, doubt.without, doubt.against
    H, L, P = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    for c in range(len(one.assignment)):
        without[c] = against[c] = -HUGE
    for c in range(len(one.assignment)):
        if one.assignment[c] < 0:
            continue
        less = copied(one)
        less.assignment[c] = -1
        without[c] = evidence(less, problem, STEPS, H, L)
        best = keep(without[c], best, less, better)
        best = _regrown(c, less, taken, problem, against, best, better)
        if without[c] > -HUGE and not math.isnan(invert6(H, L, P)):
            best = _exchanged(c, one.assignment, less, taken, problem, P, against, best, better)
    return best


@part
def _regrown(
    c: int, less: Candidate, taken: Indices, problem: Problem, against: Array, best: float, better: Candidate
) -> float:
    """Without the detection of light `c` others may find their place."""
    grown, H, L = copied(less), np.empty((6, 6)), np.empty((6, 6))
    grow(ANY, grown, taken.copy(), problem, NONE)
    if n_assigned(grown.assignment) <= n_assigned(less.assignment):
        return best
    e = evidence(grown, problem, STEPS, H, L)
    against[c] = log_add(against[c], e)
    return keep(e, best, grown, better)


@part
def _exchanged(
    c: int,
    assignment: Indices,
    less: Candidate,
    taken: Indices,
    problem: Problem,
    P: Array,
    against: Array,
    best: float,
    better: Candidate,
) -> float:
    """Another detection for light `c`; its detection for an unnamed light; or exchanged with that of a later light.

    `assignment` (M,) is the whole one; `less` is without that of `c`, its pose of covariance `P`.
    """
    gate = _FAR_GATES * problem.rules.gate
    i, h, S = assignment[c], np.empty(14), np.empty(3)
    H, L = np.empty((6, 6)), np.empty((6, 6))
    for c2 in range(len(assignment)):
        if (c2 < c and assignment[c2] >= 0) or not light_row(problem.lens, less.R, less.t, problem.p[c2], h):
            continue
        innovation(h, P, survey_var(problem.lens, less.R, less.t, problem.p[c2], problem.survey_m2[c2]), S)
        for k in range(len(problem.uv)):
            if (c2 == c and (k == i or taken[k] >= 0)) or (c2 != c and k != i):
                continue
            if nis(problem.uv[k, 0] - h[0], problem.uv[k, 1] - h[1], S, problem.var[k])[0] > gate:
                continue
            one, j = copied(less), assignment[c2]
            one.assignment[c], one.assignment[c2] = j if c2 != c else -1, k
            e = evidence(one, problem, _STEPS_EXCHANGED, H, L)
            against[c] = log_add(against[c], e)
            if c2 != c and j >= 0:
                against[c2] = log_add(against[c2], e)
            best = keep(e, best, one, better)
    return best

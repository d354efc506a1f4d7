"""Growing an association: light after light, the cheapest first, within a layer and beyond it."""

from __future__ import annotations

import math

import numpy as np

from lumidock._kernels.compiling import part
from lumidock._kernels.lens import copy_to, invert6
from lumidock._kernels.matching.evidence import (
    HUGE,
    STEPS,
    Candidate,
    Problem,
    assigned_points,
    copied,
    fit,
    keep,
    log_evidence,
    n_assigned,
    put,
    solved,
)
from lumidock._kernels.matching.gates import ANY, Expected, cheapest, expect, new_expected, support
from lumidock._kernels.pose import SAME_TURN, flip, turn
from lumidock.datatypes import Array, Indices

NONE = 0  # as the least that must be assigned
_STEPS_MORE, _STEPS_FAR = 4, 12  # after one light more; from a pose that may be far off
_BRANCHES, _FIRSTS = 2, 48  # first lights of another layer tried, of so many looked at
_HOPELESS = 30.0  # log evidence; a flipped pose this far behind is not followed


@part
def grow(allowed: int, one: Candidate, taken: Indices, problem: Problem, least: int) -> tuple[float, float, float]:
    """Assign light after light of layer `allowed` (-1: any), the cheapest first, and solve the pose after each.

    Works in place; returns what `fit` does, NaN once `least` assigned lights are out of reach.
    """
    info, gate = problem.info, problem.rules.gate
    H, L, expected, out = np.empty((6, 6)), np.empty((6, 6)), new_expected(len(one.assignment)), np.empty((1, 3))
    fitted = fit(one, problem, info, STEPS, H, L)
    for _ in range(len(one.assignment)):
        if math.isnan(fitted[1]) or math.isnan(invert6(H, L, expected.P)):
            return np.nan, np.nan, 0.0
        expect(allowed, one, problem, expected)
        found, near = cheapest(ANY, expected, taken, problem, gate, out)
        if n_assigned(one.assignment) + near < least:
            return np.nan, np.nan, 0.0
        if not found:
            break
        c, i = int(out[0, 1]), int(out[0, 2])
        one.assignment[c], taken[i] = i, c
        fitted = fit(one, problem, info, _STEPS_MORE, H, L)
    return fitted


@part
def extend(one: Candidate, taken: Indices, problem: Problem) -> float:
    """Extend a hypothesis of one layer to all, in place, over both poses of the plane and the first light beyond it.

    Growing greedily picks wrong where the tilt is open, so several first lights are tried. Returns the log evidence.
    """
    best, best_one, info, gate = -HUGE, copied(one), problem.info, problem.rules.gate
    out, tops = np.empty((_FIRSTS, 3)), np.empty((_BRANCHES, 2))
    H, L, expected = np.empty((6, 6)), np.empty((6, 6)), new_expected(len(one.assignment))
    for mode in range(2):
        start = copied(one)
        if mode == 1:
            flip(assigned_points(start.assignment, problem.p), start.R, start.t)
        e = solved(start, problem, info, _STEPS_FAR, H, L)
        if mode == 1 and (e < best - _HOPELESS or turn(start.R, one.R) < SAME_TURN):
            break
        if mode == 0:
            put(one, start)
        best = keep(e, best, start, best_one)
        if e <= -HUGE or math.isnan(invert6(H, L, expected.P)):
            continue
        expect(ANY, start, problem, expected)
        found, _ = cheapest(ANY, expected, taken, problem, gate, out)
        for k in range(_most_supported(out, found, expected, taken, problem, gate, tops)):
            trial, held = copied(start), taken.copy()
            c, i = int(out[int(tops[k, 1]), 1]), int(out[int(tops[k, 1]), 2])
            trial.assignment[c], held[i] = i, c
            fitted = grow(ANY, trial, held, problem, NONE)
            best = keep(log_evidence(trial, problem, info, fitted), best, trial, best_one)
    put(one, best_one)
    return best


@part
def _most_supported(
    out: Array, found: int, expected: Expected, taken: Indices, problem: Problem, gate: float, tops: Array
) -> int:
    """Which first lights of another layer, rows of `out`, have most support there; into `tops`, best first.

    In wider gates, and of one pixel each: what is to be compared is the lights.
    """
    kept, var = 0, np.ones(len(taken))
    for k in range(found):
        c, i = int(out[k, 1]), int(out[k, 2])
        worth = support(c, i, expected, taken, problem, var, 1.0, 2.0 * gate) - 1e-3 * out[k, 0]
        if kept < len(tops):
            kept += 1
        elif worth <= tops[kept - 1, 0]:
            continue
        at = kept - 1
        while at > 0 and tops[at - 1, 0] < worth:
            copy_to(tops[at - 1], tops[at])
            at -= 1
        tops[at, 0], tops[at, 1] = worth, k
    return kept

"""The search for the most probable associations of detections without history, and when it may stop.

Two detections given to two lights of a layer give a pose for the expected attitude; where the other lights of that
layer then have detections within their gates, a third light is given one, and the association grown.
"""

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
    copied,
    evidence,
    fit,
    log_evidence,
    n_assigned,
    put,
)
from lumidock._kernels.matching.gates import ANY, Expected, cheapest, expect, new_expected, support
from lumidock._kernels.matching.grow import NONE, extend, grow
from lumidock._kernels.matching.pairs import (
    MERIT,
    MERITS,
    SUPPORT,
    Pair,
    PairPose,
    in_place,
    know_pair,
    new_pair_pose,
    pair_of,
    pair_poses,
)
from lumidock.datatypes import Array, Indices

_THIRDS, _ALL_THIRDS = 3, 24  # third lights tried for a pair; and where three are all there may be
_FOURTHS = 4  # fourth lights tried for each
_STEPS_THREE = 2  # of Gauss-Newton for three lights, whose tilt is open: they place a fourth, and then all are solved
_CLOSE = 10.0  # log evidence; an association of one layer this far behind the best is still tried with the others


LEAST, FLOOR, MOST, IN_LAYER, LEVEL = range(5)  # entries of `Goal.bounds`


class Hypotheses(NamedTuple):
    """K hypotheses, filled in place.

    `assignments` (K, M): the detection of each light or -1; `log_evidence` (K,) over "all clutter"; T_cam_dock `R`
    (K, 3, 3), `t` (K, 3).
    """

    assignments: Indices
    log_evidence: Array
    R: Array
    t: Array


class Goal(NamedTuple):
    """What a search still looks for.

    `bounds` (5,): the `LEAST` lights of one layer; the least in all (`FLOOR`); the `MOST` assigned so far, less one;
    the most in one layer so far, less one (`IN_LAYER`); how many of one layer are wanted now (`LEVEL`). `most_work`:
    units of the problem's work at which it gives up. `best` (1,): log evidence so far.
    """

    bounds: Indices
    most_work: int
    best: Array


@entry
def search(problem: Problem, pairs: Indices, unseen: Indices, goal: Goal, count: int, hypotheses: Hypotheses) -> int:
    """Add the best hypotheses to the `count` of a list; returns how many there are then.

    `pairs` (S, 2) are lights of one layer, in order; `unseen` (S,) is the most lights of one layer that a hypothesis
    can assign without any pair before that one. Hypotheses are looked for level by level, those with most lights of a
    layer first: by the pairs of lights that no such hypothesis does without, and by those detections for them that
    leave enough others in place, most first. What is tried again on a lower level costs little: the more lights are
    wanted, the sooner a try ends. The search stops when what it has not seen cannot come within one light of the best,
    in all or in any one layer, so that it is exhaustive in what matters; or, unfinished, when its work is done.
    """
    lights, layers, done = len(problem.p), problem.like.shape[1], 0
    pose, expected = new_pair_pose(problem), new_expected(lights)
    tries = np.empty((0, 7))
    thirds = np.empty((_THIRDS if goal.bounds[LEAST] > 3 else _ALL_THIRDS, 3))
    level = unseen[0] if len(unseen) else 0
    while level >= _matter(goal, layers) and problem.work[0] <= goal.most_work:
        goal.bounds[LEVEL] = level
        while done < len(pairs) and unseen[done] >= level and problem.work[0] <= goal.most_work:
            least = max(_matter(goal, layers) - 2, 1)
            both = (pairs[done, 0], pairs[done, 1])
            tries = np.concatenate((tries, pair_poses(both, least, goal.most_work, problem, pose, expected)))
            done += 1
        for o in _most_first(tries, lights):
            if tries[o, SUPPORT] < _wanted(goal, layers) - 2 or problem.work[0] > goal.most_work:
                break
            count = _try_pair(pair_of(tries[o], lights), problem, pose, expected, thirds, goal, count, hypotheses)
        level -= 1
    for k in range(count):
        one = Candidate(hypotheses.assignments[k], hypotheses.R[k], hypotheses.t[k])
        hypotheses.log_evidence[k] = evidence(one, problem, STEPS, pose.H, pose.L)
    return count


@part
def _most_first(tries: Array, lights: int) -> Indices:
    """The order (K,) of tries that have most other lights in place first, of these the likelier, then the earlier."""
    order, start = np.empty(len(tries), np.int64), np.zeros(MERITS * (lights + 2) + 1, np.int64)
    for row in tries:
        start[int(row[SUPPORT]) * MERITS + int(row[MERIT])] += 1
    for k in range(len(start) - 2, -1, -1):  # from counts to the place after all that come first or are as good
        start[k] += start[k + 1]
    for o in range(len(tries) - 1, -1, -1):
        k = int(tries[o, SUPPORT]) * MERITS + int(tries[o, MERIT])
        start[k] -= 1
        order[start[k]] = o
    return order


@part
def _matter(goal: Goal, layers: int) -> int:
    """How many lights of one layer a hypothesis must assign to matter."""
    bounds = goal.bounds
    return max(bounds[LEAST], bounds[IN_LAYER], (max(bounds[MOST], bounds[FLOOR]) + layers - 1) // layers)


@part
def _wanted(goal: Goal, layers: int) -> int:
    """How many lights of one layer are looked for now."""
    return max(goal.bounds[LEVEL], _matter(goal, layers))


@part
def _try_pair(
    pair: Pair,
    problem: Problem,
    pose: PairPose,
    expected: Expected,
    thirds: Array,
    goal: Goal,
    count: int,
    hypotheses: Hypotheses,
) -> int:
    """Grow associations from a pair and a third light that ranks after both, so that each triple comes once."""
    rank, gate, taken = problem.rank, problem.rules.pair_gate, pose.taken
    a, b, i, j = pair.a, pair.b, pair.i, pair.j
    assignment, layers = np.empty(len(rank), np.int64), problem.like.shape[1]
    taken[i], taken[j] = a, b
    know_pair(pair, problem, pose, expected.rows[a], expected.P)
    in_place(pair, NONE, problem, pose, expected)
    found, _ = cheapest(max(rank[a], rank[b]), expected, taken, problem, gate, thirds)
    for k in range(found):
        c, o = int(thirds[k, 1]), int(thirds[k, 2])
        if problem.work[0] > goal.most_work:
            break
        if _known(pair, c, o, hypotheses.assignments, count):
            continue
        wanted = _wanted(goal, layers)
        if wanted > 3 and wanted > 3 + support(c, o, expected, taken, problem, problem.var, problem.loosest, gate):
            continue
        for m in range(len(assignment)):
            assignment[m] = -1
        assignment[a], assignment[b], assignment[c], taken[o] = i, j, o, c
        count = _try_three(
            Candidate(assignment, pose.R, pose.t), taken, problem.layer[a], problem, goal, count, hypotheses
        )
        taken[o] = -1
    taken[i], taken[j] = -1, -1
    return count


@part
def _known(pair: Pair, c: int, o: int, assignments: Indices, count: int) -> bool:
    """Whether one of `count` listed hypotheses holds a pair, and gives light `c` the detection `o`."""
    for k in range(count):
        if assignments[k, pair.a] == pair.i and assignments[k, pair.b] == pair.j and assignments[k, c] == o:
            return True
    return False


@part
def _try_three(
    three: Candidate, held: Indices, layer: int, problem: Problem, goal: Goal, count: int, hypotheses: Hypotheses
) -> int:
    """Grow associations from three lights and list them: the cheapest fourth first, then those it led away from."""
    layers, fourths, expected = problem.like.shape[1], np.empty((_FOURTHS, 3)), new_expected(len(three.assignment))
    H, L, start = np.empty((6, 6)), np.empty((6, 6)), copied(three)
    fit(start, problem, problem.info, _STEPS_THREE, H, L)
    if math.isnan(invert6(H, L, expected.P)):
        return count
    expect(layer, start, problem, expected)
    found, near = cheapest(ANY, expected, held, problem, problem.rules.gate, fourths)
    first = start.assignment
    for k in range(max(found, 1)):
        if 3 + near < _wanted(goal, layers):
            break
        one, taken = copied(start), held.copy()
        if found:
            c, o = int(fourths[k, 1]), int(fourths[k, 2])
            if first[c] == o:
                continue
            one.assignment[c], taken[o] = o, c
        e = _grown(layer, one, taken, problem, goal)
        if k == 0:
            first = one.assignment
        if e > -HUGE and n_assigned(one.assignment) >= goal.bounds[FLOOR]:
            count = _store(one, e, count, hypotheses)
            _aim(one.assignment, e, problem.layer, layers, goal)
    return count


@part
def _grown(layer: int, one: Candidate, taken: Indices, problem: Problem, goal: Goal) -> float:
    """Log evidence of an association of one layer, grown in place: first within the layer, then over all."""
    fitted = grow(layer, one, taken, problem, _wanted(goal, problem.like.shape[1]))
    e = log_evidence(one, problem, problem.info, fitted)
    if e <= -HUGE or n_assigned(one.assignment) < goal.bounds[LEAST]:
        return -HUGE
    if e > goal.best[0] - _CLOSE or (e > 0.0 and n_assigned(one.assignment) > 3):
        e = extend(one, taken, problem)
    return e


@part
def _aim(assignment: Indices, e: float, layer: Indices, layers: int, goal: Goal) -> None:
    """Raise what is still looked for to what a new best hypothesis assigns."""
    if e <= goal.best[0]:
        return
    goal.best[0] = e
    if e > 0.0:
        goal.bounds[MOST] = max(goal.bounds[MOST], n_assigned(assignment) - 1)
        goal.bounds[IN_LAYER] = max(goal.bounds[IN_LAYER], _most_in_layer(assignment, layer, layers) - 1)


@part
def _most_in_layer(assignment: Indices, layer: Indices, layers: int) -> int:
    count = np.zeros(layers, np.int64)
    for c in range(len(assignment)):
        if assignment[c] >= 0:
            count[layer[c]] += 1
    most = 0
    for k in range(layers):
        most = max(most, count[k])
    return most


@part
def _store(one: Candidate, e: float, count: int, hypotheses: Hypotheses) -> int:
    """List a hypothesis unless it is known or worse than all of a full list; returns how many there are."""
    scores = hypotheses.log_evidence
    for k in range(count):
        if _same(hypotheses.assignments[k], one.assignment):
            if e > scores[k]:
                scores[k] = e
                put(Candidate(hypotheses.assignments[k], hypotheses.R[k], hypotheses.t[k]), one)
            return count
    at = count
    if count == len(scores):
        at = 0
        for k in range(1, count):
            at = k if scores[k] < scores[at] else at
        if scores[at] >= e:
            return count
    scores[at] = e
    put(Candidate(hypotheses.assignments[at], hypotheses.R[at], hypotheses.t[at]), one)
    return max(count, at + 1)


@part
def _same(a: Indices, b: Indices) -> bool:
    for c in range(len(a)):  # noqa: SIM110 - numba compiles no generator
        if a[c] != b[c]:
            return False
    return True

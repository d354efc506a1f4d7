"""The search for the most probable naming of detections without history, and when it may stop.

Two detections named after two lights of a layer give a pose for the expected attitude; where the other lights of that
layer then have detections within their gates, a third one is named, and the naming grown.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.lens import invert6
from lumidock._kernels.matching.evidence import (
    GATE,
    HUGE,
    PAIR_GATE,
    STEPS,
    Naming,
    Scene,
    copied,
    evidence,
    fit,
    log_evidence,
    named,
    put,
)
from lumidock._kernels.matching.gates import ANY, Sight, cheapest, look, new_sight, support
from lumidock._kernels.matching.grow import NONE, extend, grow
from lumidock._kernels.matching.pairs import Pair, View, in_place, know_pair, new_view, pair_poses
from lumidock.datatypes import Array, Indices

_THIRDS, _ALL_THIRDS = 3, 24  # third lights tried for a pair; and where three are all there may be
_FOURTHS = 4  # fourth lights tried for each
_CLOSE = 10.0  # log evidence; a naming of one layer this far behind the best is still tried with the others


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


@entry
def search(scene: Scene, pairs: Indices, unseen: Indices, goal: Goal, count: int, listed: Listed) -> int:
    """Add the best hypotheses to the `count` of a list; returns how many there are then.

    `pairs` (S, 2) are lights of one layer, in order; `unseen` (S,) is the most lights of one layer that a hypothesis
    can name without naming any pair before that one. The search stops when what it has not seen cannot come within one
    light of the best, in all or in any one layer, so that it is exhaustive in what matters; or when its budget is
    spent, which then is negative. Of a pair of lights those detections come first that leave most others in place.
    """
    n, layers = scene.like.shape
    view, sight = new_view(scene), new_sight(len(scene.p))
    tries = np.empty((2 * n * n, 5))
    thirds = np.empty((_THIRDS if goal.bounds[0] > 3 else _ALL_THIRDS, 3))
    for s in range(len(pairs)):
        if unseen[s] < _wanted(goal, layers):
            break
        a, b = pairs[s]
        found = pair_poses(a, b, max(_wanted(goal, layers) - 2, 1), scene, view, sight, goal.budget, tries)
        for o in _most_first(tries, found, len(scene.p)):
            if tries[o, 0] < max(_wanted(goal, layers) - 2, 1):
                break
            pair = Pair(a, b, int(tries[o, 1]), int(tries[o, 2]), tries[o, 3], tries[o, 4])
            count = _try_pair(pair, scene, view, sight, thirds, goal, count, listed)
        if goal.budget[0] < 0:
            break
    for k in range(count):
        one = Naming(listed.names[k], listed.Rs[k], listed.ts[k])
        listed.scores[k] = evidence(one, scene, STEPS, view.H, view.L)
    return count


@part
def _most_first(tries: Array, found: int, lights: int) -> Indices:
    """The order (found,) of rows that have most other lights in place first, and of equal ones the earlier."""
    order, start = np.empty(found, np.int64), np.zeros(lights + 2, np.int64)
    for o in range(found):
        start[int(tries[o, 0])] += 1
    for k in range(lights, -1, -1):  # from counts to the place after all that have as many or more
        start[k] += start[k + 1]
    for o in range(found - 1, -1, -1):
        k = int(tries[o, 0])
        start[k] -= 1
        order[start[k]] = o
    return order


@part
def _wanted(goal: Goal, layers: int) -> int:
    """How many lights of one layer a hypothesis must name to matter."""
    least, floor, most, in_layer = goal.bounds
    return max(least, in_layer, (max(most, floor) + layers - 1) // layers)


@part
def _try_pair(
    pair: Pair, scene: Scene, view: View, sight: Sight, thirds: Array, goal: Goal, count: int, listed: Listed
) -> int:
    """Grow namings from a pair and a third light, and list them. Each triple is tried once: the third ranks last."""
    rank, gate, taken = scene.rank, scene.q[PAIR_GATE], view.taken
    a, b, i, j = pair.a, pair.b, pair.i, pair.j
    name, layers = np.empty(len(rank), np.int64), scene.like.shape[1]
    taken[i], taken[j] = a, b
    know_pair(pair, scene, view, sight.rows[a], sight.P)
    in_place(pair, NONE, scene, view, sight)
    found, _ = cheapest(max(rank[a], rank[b]), sight, taken, scene, gate, thirds)
    for k in range(found):
        c, o = int(thirds[k, 1]), int(thirds[k, 2])
        if _known(pair, c, o, listed.names, count):
            continue
        wanted = _wanted(goal, layers)
        if wanted > 3 and wanted > 3 + support(c, o, sight, taken, scene, scene.var, scene.loosest, gate):
            continue
        for m in range(len(name)):
            name[m] = -1
        name[a], name[b], name[c], taken[o] = i, j, o, c
        count = _try_three(Naming(name, view.R, view.t), taken, scene.layer[a], scene, goal, count, listed)
        taken[o] = -1
    taken[i], taken[j] = -1, -1
    return count


@part
def _known(pair: Pair, c: int, o: int, names: Indices, count: int) -> bool:
    """Whether one of `count` listed hypotheses names a pair, and light `c` after detection `o`."""
    for k in range(count):  # noqa: SIM110 - numba compiles no generator
        if names[k, pair.a] == pair.i and names[k, pair.b] == pair.j and names[k, c] == o:
            return True
    return False


@part
def _try_three(three: Naming, held: Indices, layer: int, scene: Scene, goal: Goal, count: int, listed: Listed) -> int:
    """Grow namings from three, and list them: the cheapest fourth light first, then others that it led away from."""
    layers, fourths, sight = scene.like.shape[1], np.empty((_FOURTHS, 3)), new_sight(len(three.name))
    H, L, start = np.empty((6, 6)), np.empty((6, 6)), copied(three)
    fit(start, scene, scene.info, STEPS, H, L)
    if math.isnan(invert6(H, L, sight.P)):
        return count
    look(layer, start, scene, sight)
    found, near = cheapest(ANY, sight, held, scene, scene.q[GATE], fourths)
    first = start.name
    for k in range(max(found, 1)):
        if 3 + near < _wanted(goal, layers):
            break
        one, taken = copied(start), held.copy()
        if found:
            c, o = int(fourths[k, 1]), int(fourths[k, 2])
            if first[c] == o:
                continue
            one.name[c], taken[o] = o, c
        e = _grown(layer, one, taken, scene, goal)
        if k == 0:
            first = one.name
        if e > -HUGE and named(one.name) >= goal.bounds[1]:
            count = _store(one, e, count, listed)
            _aim(one.name, e, scene.layer, layers, goal)
    return count


@part
def _grown(layer: int, one: Naming, taken: Indices, scene: Scene, goal: Goal) -> float:
    """Log evidence of a naming of one layer, grown in place: first within the layer, then over all."""
    fitted = grow(layer, one, taken, scene, _wanted(goal, scene.like.shape[1]))
    e = log_evidence(one, scene, scene.info, fitted)
    if e <= -HUGE or named(one.name) < goal.bounds[0]:
        return -HUGE
    if e > goal.best[0] - _CLOSE or (e > 0.0 and named(one.name) > 3):
        e = extend(one, taken, scene)
    return e


@part
def _aim(name: Indices, e: float, layer: Indices, layers: int, goal: Goal) -> None:
    """Raise what is still looked for to what a new best hypothesis names."""
    if e <= goal.best[0]:
        return
    goal.best[0] = e
    if e > 0.0:
        goal.bounds[2] = max(goal.bounds[2], named(name) - 1)
        goal.bounds[3] = max(goal.bounds[3], _most_in_layer(name, layer, layers) - 1)


@part
def _most_in_layer(name: Indices, layer: Indices, layers: int) -> int:
    count = np.zeros(layers, np.int64)
    for c in range(len(name)):
        if name[c] >= 0:
            count[layer[c]] += 1
    most = 0
    for k in range(layers):
        most = max(most, count[k])
    return most


@part
def _store(one: Naming, e: float, count: int, listed: Listed) -> int:
    """List a hypothesis unless it is known or worse than all of a full list; returns how many there are."""
    scores = listed.scores
    for k in range(count):
        if _same(listed.names[k], one.name):
            if e > scores[k]:
                scores[k] = e
                put(Naming(listed.names[k], listed.Rs[k], listed.ts[k]), one)
            return count
    at = count
    if count == len(scores):
        at = 0
        for k in range(1, count):
            at = k if scores[k] < scores[at] else at
        if scores[at] >= e:
            return count
    scores[at] = e
    put(Naming(listed.names[at], listed.Rs[at], listed.ts[at]), one)
    return max(count, at + 1)


@part
def _same(a: Indices, b: Indices) -> bool:
    for c in range(len(a)):  # noqa: SIM110 - numba compiles no generator
        if a[c] != b[c]:
            return False
    return True

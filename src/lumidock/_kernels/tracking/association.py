"""The most probable associations under a prediction, by a search over all lights together."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.lens import copy_to
from lumidock._kernels.measurements import Measurements
from lumidock._kernels.tracking.track import PredictedMeasurements
from lumidock.datatypes import Array, Indices

_LOG_2PI = math.log(2.0 * math.pi)


class Terms(NamedTuple):
    """What associations are weighed by.

    The probability that a light is detected, the gate on NIS, how much cost behind the best is still followed, and how
    many nodes the search may visit.
    """

    detect: float
    gate: float
    reach: float
    max_nodes: int


class Ranking(NamedTuple):
    """The best K associations: the detection of each light or -1, `assignments` (K, M), and `costs`."""

    assignments: Indices
    costs: Array


@entry
def associate(
    predicted: PredictedMeasurements, layer: Indices, frame: Measurements, terms: Terms, ranking: Ranking
) -> int:
    """The most probable associations of a `frame` under the prediction, best first, into `ranking`; returns how many.

    It returns -1 where the search would take more than `max_nodes`: a part of it says nothing.

    A depth-first search over the lights, each with the detections in its gate or none; every assigned light conditions
    those after it through their joint covariance (J. Neira, J. Tardos, 2001). Costs are -log evidence over "all
    clutter"; associations more than `reach` behind the best are not followed.
    """
    (expected, S, shown), m = predicted, len(predicted.shown)
    uv, var, like, log_clutter = frame.uv, frame.var, frame.like, frame.log_density
    detect, gate, reach, max_nodes = terms
    cand, n_cand = _candidates(predicted, uv, var, gate)
    order, always, miss = _fewest_first(n_cand, len(uv)), 0.0, -math.log(1.0 - detect)
    for c in range(m):
        if n_cand[c] == 0 and shown[c] == 2.0:
            always += miss
    least, depth = _least(predicted, order, cand, n_cand, layer, frame, terms), len(order)
    chosen, L, w = np.empty(m, np.int64), np.empty((2 * m, 2 * m)), np.empty(2 * m)
    count, cost, at = np.zeros(m + 1, np.int64), np.zeros(m + 1), np.zeros(m + 1, np.int64)
    assignment, taken = np.full(m, -1, np.int64), np.full(len(uv), -1, np.int64)
    found, d, nodes, best = 0, 0, 0, np.inf
    while d >= 0:
        if d == depth:
            best = min(best, cost[d])
            found = _keep(assignment, cost[d] + always, ranking, found)
            d -= 1
            continue
        c, k = order[d], at[d]
        if assignment[c] >= 0:
            taken[assignment[c]] = -1
            assignment[c] = -1
        at[d], nodes = k + 1, nodes + 1
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
            price = _assign_one(expected, S, L, w, chosen, count[d], c, uv[i], var[i], gate)
            if math.isnan(price):
                continue
            cost[d + 1] = cost[d] + price + log_clutter - math.log(detect) - like[i, layer[c]]
            chosen[count[d]] = c
            count[d + 1] = count[d] + 1
            assignment[c], taken[i] = i, c
        if cost[d + 1] + least[d + 1] > best + reach:
            continue
        d += 1
        at[d] = 0
    return found


@part
def _candidates(predicted: PredictedMeasurements, uv: Array, var: Array, gate: float) -> tuple[Indices, Indices]:
    """The detections in each light's gate, the likeliest first (M, N), and how many (M,)."""
    m = len(predicted.shown)
    cand, n_cand = np.empty((m, len(uv)), np.int64), np.zeros(m, np.int64)
    for c in range(m):
        if predicted.shown[c] > 0.0:
            n_cand[c] = _in_gate(predicted, c, uv, var, gate, cand[c])
    return cand, n_cand


@part
def _in_gate(predicted: PredictedMeasurements, c: int, uv: Array, var: Array, gate: float, cand: Indices) -> int:
    """The detections in the gate of light `c`, the likeliest first: fills `cand` (N,), returns how many."""
    S, u, v = predicted.S, predicted.uv[c, 0], predicted.uv[c, 1]
    a, b, d = S[2 * c, 2 * c], S[2 * c, 2 * c + 1], S[2 * c + 1, 2 * c + 1]
    costs, n = np.empty(len(uv)), 0
    for i in range(len(uv)):
        du, dv = uv[i, 0] - u, uv[i, 1] - v
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


@part
def _fewest_first(n_cand: Indices, most: int) -> Indices:
    """The lights (D,) that have candidates, up to `most` each, in the order of how many."""
    order, depth = np.empty(len(n_cand), np.int64), 0
    for want in range(1, most + 1):
        for c in range(len(n_cand)):
            if n_cand[c] == want:
                order[depth] = c
                depth += 1
    return order[:depth]


@part
def _least(
    predicted: PredictedMeasurements,
    order: Indices,
    cand: Indices,
    n_cand: Indices,
    layer: Indices,
    frame: Measurements,
    terms: Terms,
) -> Array:
    """The least (D + 1,) that all lights from each depth of `order` on can cost."""
    var, like = frame.var, frame.like
    depth, miss, sharpest = len(order), -math.log(1.0 - terms.detect), np.inf
    least, narrow = np.zeros(depth + 1), np.empty((depth, 3))
    for i in range(len(var)):
        sharpest = min(sharpest, var[i])
    _narrowest(predicted.S, order, sharpest, narrow)
    for d in range(depth - 1, -1, -1):
        c = order[d]
        low = miss if predicted.shown[c] == 2.0 else 0.0
        for k in range(n_cand[c]):
            i = cand[c, k]
            det = (narrow[d, 0] + var[i]) * (narrow[d, 2] + var[i]) - narrow[d, 1] ** 2
            price = _LOG_2PI + 0.5 * math.log(max(det, var[i] * var[i]))
            low = min(low, price - math.log(terms.detect) - like[i, layer[c]] + frame.log_density)
        least[d] = least[d + 1] + low
    return least


@part
def _narrowest(S: Array, order: Indices, var: float, narrow: Array) -> None:
    """Covariance uu, uv, vv (D, 3) of each light's pixel when all before it in `order` (D,) are assigned.

    With fewer of them assigned it is wider: what it costs to assign a light is never less.
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


@part
def _assign_one(
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
    """Cost of giving light `c` a detection, given the `count` `chosen` before; NaN outside the gate.

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


@part
def _keep(assignment: Indices, cost: float, ranking: Ranking, found: int) -> int:
    """Put an association into the sorted list; returns how many there are then."""
    assignments, costs = ranking
    k = len(costs)
    if found == k and cost >= costs[k - 1]:
        return found
    if found < k:
        found += 1
    at = found - 1
    while at > 0 and costs[at - 1] > cost:
        costs[at] = costs[at - 1]
        copy_to(assignments[at - 1], assignments[at])
        at -= 1
    costs[at] = cost
    copy_to(assignment, assignments[at])
    return found

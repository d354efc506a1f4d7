"""Which detections lie in the gates of lights that have no detection yet."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import part
from lumidock._kernels.lens import copy_to
from lumidock._kernels.matching.evidence import HUGE, SCAN_WORK, Candidate, Problem, innovation, survey_var
from lumidock._kernels.pose import light_row
from lumidock.datatypes import Array, Indices

ANY = -1  # layer; or rank that all lights come after
_NEAR = 2.0  # gates within which a detection may still come to lie in its gate


class Expected(NamedTuple):
    """Pixels predicted for lights from a pose of covariance `P` (6, 6).

    Pixel and Jacobian `rows` (M, 14), `S` (M, 3) covariance px^2 without that of a detection, `extra` (M,) px^2 the
    share of it that the pose has no part in, `sought` (M,) which lights have a detection to be found.
    """

    rows: Array
    S: Array
    extra: Array
    sought: np.ndarray
    P: Array


@part
def new_expected(m: int) -> Expected:
    """Room for `m` lights, none of which is sought."""
    return Expected(np.empty((m, 14)), np.empty((m, 3)), np.empty(m), np.zeros(m, np.bool_), np.empty((6, 6)))


@part
def expect(allowed: int, one: Candidate, problem: Problem, expected: Expected) -> None:
    """Predict the pixels of lights without a detection, of layer `allowed` or any (-1); fills `expected` but `P`."""
    rows, S, extra, sought = expected.rows, expected.S, expected.extra, expected.sought
    assignment, R, t = one
    for c in range(len(assignment)):
        sought[c] = assignment[c] < 0 and (allowed < 0 or problem.layer[c] == allowed)
        if sought[c]:
            sought[c] = light_row(problem.lens, R, t, problem.p[c], rows[c])
        if sought[c]:
            extra[c] = survey_var(problem.lens, R, t, problem.p[c], problem.survey_m2[c])
            innovation(rows[c], expected.P, extra[c], S[c])


@part
def cheapest(
    after: int, expected: Expected, taken: Indices, problem: Problem, gate: float, out: Array
) -> tuple[int, int]:
    """The lights sought that rank after `after` and have a free detection inside their gate, cheapest first.

    Fills rows of `out` (K, 3) with NIS + log det S - 2 log likelihood, light and detection; returns how many, and how
    many lights have a detection not far outside their gate.
    """
    rank, layer, uv, var, like, by_u = (
        problem.rank,
        problem.layer,
        problem.uv,
        problem.var,
        problem.like,
        problem.by_u,
    )
    found, near = 0, 0
    problem.work[0] += 1 + len(problem.uv) // SCAN_WORK
    for c in range(len(layer)):
        if not expected.sought[c] or rank[c] <= after:
            continue
        u, v, S, least = expected.rows[c, 0], expected.rows[c, 1], expected.S[c], HUGE
        reach = math.sqrt(_NEAR * gate * (S[0] + problem.loosest))
        for k in range(_first(uv, by_u, u - reach), len(by_u)):
            i = by_u[k]
            if uv[i, 0] - u > reach:
                break
            if taken[i] >= 0:
                continue
            square, det = nis(uv[i, 0] - u, uv[i, 1] - v, S, var[i])
            least = min(least, square)
            if square <= gate:
                found = _insert(out, found, square + math.log(det) - 2.0 * like[i, layer[c]], c, i)
        near += least <= _NEAR * gate
    return found, near


@part
def nis(du: float, dv: float, S: Array, var: float) -> tuple[float, float]:
    """Normalised innovation squared of a detection (du, dv) px off, and the determinant px^4 of its covariance."""
    s0, s1, s2 = S[0] + var, S[1], S[2] + var
    det = s0 * s2 - s1 * s1
    return (s2 * du * du - 2.0 * s1 * du * dv + s0 * dv * dv) / det, det


@part
def _insert(out: Array, found: int, price: float, c: int, i: int) -> int:
    """Put a row into `out` (K, 3), cheapest first, unless all of a full one are cheaper; returns how many rows."""
    if found < len(out):
        found += 1
    elif price >= out[found - 1, 0]:
        return found
    at = found - 1
    while at > 0 and out[at - 1, 0] > price:
        copy_to(out[at - 1], out[at])
        at -= 1
    out[at, 0], out[at, 1], out[at, 2] = price, c, i
    return found


@part
def support(
    c: int, i: int, expected: Expected, taken: Indices, problem: Problem, var: Array, loosest: float, gate: float
) -> int:
    """How many other lights sought in the layer find a free detection once detection `i` is given to light `c`.

    By one linear update of the pose and its covariance. `var` (N,) px^2 of the detections, `loosest` the largest.
    """
    rows, layer, uv, by_u = expected.rows, problem.layer, problem.uv, problem.by_u
    row, S, P2, shift, found = rows[c], np.empty(3), np.empty((6, 6)), np.empty(6), 0
    problem.work[0] += 1 + len(problem.uv) // SCAN_WORK
    S[0], S[1], S[2] = expected.S[c, 0] + problem.var[i], expected.S[c, 1], expected.S[c, 2] + problem.var[i]
    _condition(row, expected.P, S, uv[i, 0] - row[0], uv[i, 1] - row[1], P2, shift)
    taken[i] = c
    for other in range(len(layer)):
        if other == c or not expected.sought[other] or layer[other] != layer[c]:
            continue
        row = rows[other]
        innovation(row, P2, expected.extra[other], S)
        u, v = row[0], row[1]
        for k in range(6):
            u += row[2 + k] * shift[k]
            v += row[8 + k] * shift[k]
        found += occupied(u, v, S, taken, uv, var, loosest, by_u, gate)
    taken[i] = -1
    return found


@part
def _condition(h: Array, P: Array, S: Array, du: float, dv: float, P2: Array, shift: Array) -> None:
    """Kalman update of a pose's covariance `P` by one pixel: `P2`, and the `shift` (6,) of the pose."""
    det, gain = S[0] * S[2] - S[1] * S[1], np.empty((6, 2))
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


@part
def occupied(
    u: float,
    v: float,
    S: Array,
    taken: Indices,
    uv: Array,
    var: Array,
    loosest: float,
    by_u: Indices,
    gate: float,
) -> bool:
    """Whether a free detection lies in the gate of covariance `S` (3,) about a pixel. Arrays at hand: it is hot."""
    reach = math.sqrt(gate * (S[0] + loosest))
    for k in range(_first(uv, by_u, u - reach), len(by_u)):
        d = by_u[k]
        du, dv = uv[d, 0] - u, uv[d, 1] - v
        if du > reach:
            return False
        s0, s1, s2 = S[0] + var[d], S[1], S[2] + var[d]
        if s2 * du * du - 2.0 * s1 * du * dv + s0 * dv * dv < gate * (s0 * s2 - s1 * s1) and taken[d] < 0:
            return True
    return False


@part
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

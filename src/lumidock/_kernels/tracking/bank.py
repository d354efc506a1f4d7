"""A bank of subset states beside the filter: for every light in use a pose and twist that never saw that light.

Whatever a wrong identity did to the filter since the track began, the state that is blind to this light is free of it.
How far the two are apart bounds what the fault may have done (solution separation over the whole history: M. Joerger,
B. Pervan, "Kalman filter-based integrity monitoring against sensor faults", 2013).

All subsets share the filter's association and its linearisation. They consider the errors of survey and calibration
with the covariance that the files declare and never estimate them (S. F. Schmidt, 1966), so that no fault can enter
there either. The last subset leaves no light out; the state that is blind to a light branches off it when the light is
first used.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.lens import copy_to, factor
from lumidock._kernels.pose import attitude_error, set_pose
from lumidock._kernels.tracking.slant import flatten
from lumidock._kernels.tracking.track import (
    BIAS,
    CALIBRATION,
    FilterState,
    Lights,
    adjoint,
    difference,
    dot_row,
    move_covariance,
    row,
)
from lumidock._kernels.tracking.update import Assigned, whiten_gains, whiten_innovation
from lumidock.datatypes import Array, Indices

MOVING = 12  # states that a subset has of its own: pose and twist
_FLATTENINGS, _FLATTENED = 12, 1.02  # of a start: the flatter the view, the wider the tilt, until it grows no more
_PRESENT_NIS = 9.2  # chi-square, 2 dof, 1 %: a light is where its blind state expects it


class Bank(NamedTuple):
    """S = M + 1 subset states of n states each, the last with all lights.

    `offset` (S, 12): pose and twist of each against the filter's. `P` (S, 12, n): the rows of pose and twist of its
    covariance. `considered` (n, n): covariance of all other states, the same for every subset. `begun` (S,): 1 where
    the state stands for itself. `plane` (S,): the layer on whose plane its last lights all lay, or -1. `seen` (M,): 1
    where the last frame had the light. `proven` (M,): 1 where geometry has proven it.
    """

    offset: Array
    P: Array
    considered: Array
    begun: Indices
    plane: Indices
    seen: Indices
    proven: Indices


class BankRules(NamedTuple):
    """How the subsets are updated.

    `layer` (M,) of each light and the `planes` (L, 6) of the layers. `depth_known`: the track has seen two layers, so
    that four lights of one hold the tilt. `starting`: the first frame of a track; the tilt of a plane is as open as
    `turn_cov` (3, 3) rad^2 at least. A light that its blind state predicts to `proven_m` m, 1 sigma, is proven.
    """

    layer: Indices
    planes: Array
    depth_known: bool
    starting: bool
    turn_cov: Array
    proven_m: float


class _Work(NamedTuple):
    """The K lights of a frame: `lights` (K,), `h` (K, 14) and `cal` (K, 2) as in `row`, and work space.

    `D` (2 K, n) holds the rows H P of what is only considered; `Z` (2 K, 2 K), `G` (2 K, n) and `nu` (2 K,) are those
    of the filter's update; `delta` (n,) is a subset's distance from the filter, whose calibration it does not know.
    """

    lights: Indices
    h: Array
    cal: Array
    D: Array
    Z: Array
    G: Array
    nu: Array
    delta: Array


@entry
def predict_bank(bank: Bank, state: FilterState, dt: float, q_lin: float, q_ang: float) -> None:
    """Move all subsets on by `dt` s, in place; `state` is the filter's, moved already."""
    A = adjoint(state.R, state.t)
    for s in range(len(bank.begun)):
        if bank.begun[s] == 0:
            continue
        offset = bank.offset[s]
        for i in range(6):
            for k in range(6):
                offset[i] -= dt * A[i, k] * offset[6 + k]
        move_covariance(bank.P[s], A, dt, q_lin, q_ang)


@entry
def attitude_bank(bank: Bank, state: FilterState, Rp: Array, var: Array) -> None:
    """Update all subsets by a sensor's attitude `Rp` (3, 3) of variance `var` (3,) rad^2; `state` is not updated yet.

    The sensor's bias is considered: it never averages away.
    """
    n, considered = len(bank.considered), bank.considered
    e, J, g = np.empty(3), np.empty((3, 3)), np.empty(n)
    attitude_error(state.R, Rp, e, J)
    for s in range(len(bank.begun)):
        if bank.begun[s] == 0:
            continue
        offset, P = bank.offset[s], bank.P[s]
        for k in range(3):
            for j in range(n):
                g[j] = J[k, 0] * P[3, j] + J[k, 1] * P[4, j] + J[k, 2] * P[5, j]
                g[j] += P[j, BIAS + k] if j < MOVING else considered[BIAS + k, j]
            residual = -e[k] - J[k, 0] * offset[3] - J[k, 1] * offset[4] - J[k, 2] * offset[5]
            S = var[k] + J[k, 0] * g[3] + J[k, 1] * g[4] + J[k, 2] * g[5] + g[BIAS + k]
            for i in range(MOVING):
                offset[i] += g[i] * residual / S
                gain = g[i] / S
                for j in range(n):
                    P[i, j] -= gain * g[j]


@entry
def shift_bank(bank: Bank, before: FilterState, after: FilterState) -> None:
    """Keep all subsets where they are while the filter goes from one state to another."""
    move = np.zeros(MOVING)
    difference(before.R, before.t, after.R, after.t, move)
    for i in range(6, MOVING):
        move[i] = after.x[i] - before.x[i]
    for s in range(len(bank.begun)):
        for i in range(MOVING):
            bank.offset[s, i] -= move[i]


@entry
def update_bank(station: Lights, state: FilterState, seen: Assigned, rules: BankRules, bank: Bank) -> None:
    """Update every subset by the assigned detections but its own, in place; `state` is the updated filter's.

    Seen at a slant by mistake, a plane would seem to tell its tilt: a subset that sees only one is linearised at the
    flattest view within three sigmas of its own tilt, as in `update`.
    """
    n, m = len(state.x), len(station.p)
    work = _work(station, state, seen.assignment)
    _considered_rows(work, bank.considered)
    for c in range(m):
        if seen.assignment[c] >= 0 and bank.begun[c] == 0:
            bank.begun[c], bank.proven[c], bank.plane[c] = 1, 0, bank.plane[m]
            copy_to(bank.offset[m], bank.offset[c])
            for i in range(MOVING):
                copy_to(bank.P[m, i], bank.P[c, i])
    flat, turn_cov = FilterState(state.R.copy(), state.t.copy(), state.x, state.P), np.empty((3, 3))
    start, first = np.empty((MOVING, n)), np.empty(MOVING)
    for s in range(m + 1):
        if bank.begun[s] == 0:
            continue
        bank.plane[s] = _plane_of(s, work.lights, rules)
        if bank.plane[s] < 0:
            _update_one(s, seen, work, work, bank)
            continue
        for i in range(3):
            for j in range(3):
                turn_cov[i, j] = rules.turn_cov[i, j] if rules.starting else bank.P[s, 3 + i, 3 + j]
        for i in range(MOVING):
            copy_to(bank.P[s, i], start[i])
            first[i] = bank.offset[s, i]
        for _ in range(_FLATTENINGS if rules.starting else 1):
            for i in range(MOVING):
                copy_to(start[i], bank.P[s, i])
                bank.offset[s, i] = first[i]
            set_pose(flat.R, flat.t, state.R, state.t)
            flatten(state.R, state.t, rules.planes[bank.plane[s]], turn_cov, flat.R, flat.t)
            flattened = _work(station, flat, seen.assignment)
            if len(flattened.lights) < len(work.lights):
                flattened = work
            else:
                _considered_rows(flattened, bank.considered)
            _update_one(s, seen, work, flattened, bank)
            before, after = 0.0, 0.0
            for i in range(3):
                before += turn_cov[i, i]
                after += bank.P[s, 3 + i, 3 + i]
                for j in range(3):
                    turn_cov[i, j] = bank.P[s, 3 + i, 3 + j]
            if after < _FLATTENED * before:
                break
    _prove(station, state, seen, work, rules.proven_m, bank)


@part
def _work(station: Lights, state: FilterState, assignment: Indices) -> _Work:
    """The rows of all assigned lights that the lens sees at a state, and room for the rest."""
    n, at = len(state.x), np.empty(3)
    k = 0
    for c in range(len(assignment)):
        k += assignment[c] >= 0
    lights, h, cal = np.empty(k, np.int64), np.empty((k, 14)), np.empty((k, 2))
    k = 0
    for c in range(len(assignment)):
        if assignment[c] >= 0 and row(station, state, c, at, h[k], cal[k]):
            lights[k] = c
            k += 1
    r = 2 * k
    delta = np.zeros(n)
    for j in range(MOVING, n):
        delta[j] = -state.x[j]
    return _Work(lights[:k], h, cal, np.zeros((r, n)), np.empty((r, r)), np.empty((r, n)), np.empty(r), delta)


@part
def _considered_rows(work: _Work, considered: Array) -> None:
    """Fill `D`: H P of each pixel with what is only considered."""
    n = len(considered)
    for k in range(len(work.lights)):
        base = CALIBRATION + 3 + 3 * work.lights[k]
        for axis in range(2):
            out, scale, o = work.D[2 * k + axis], work.cal[k, axis], 2 + 6 * axis
            for j in range(MOVING, n):
                out[j] = scale * considered[CALIBRATION, j] + considered[CALIBRATION + 1 + axis, j]
            for i in range(3):
                a = work.h[k, o + i]
                for j in range(MOVING, n):
                    out[j] += a * considered[base + i, j]


@part
def _gain_row(k: int, axis: int, work: _Work, P: Array, out: Array) -> None:
    """H P (n,) of one pixel of the frame's `k`-th light with a subset's covariance `P` (12, n)."""
    base, scale, h, o = CALIBRATION + 3 + 3 * work.lights[k], work.cal[k, axis], work.h[k], 2 + 6 * axis
    copy_to(work.D[2 * k + axis], out)
    for i in range(6):
        a = h[o + i]
        for j in range(len(out)):
            out[j] += a * P[i, j]
    for j in range(MOVING):
        s = scale * P[j, CALIBRATION] + P[j, CALIBRATION + 1 + axis]
        for i in range(3):
            s += h[o + i] * P[j, base + i]
        out[j] += s


@part
def _update_one(s: int, seen: Assigned, pixels: _Work, rows: _Work, bank: Bank) -> None:
    """Update one subset by all lights of the frame but `s`: innovations of `pixels`, Jacobians of `rows`."""
    n, P, offset, delta = len(bank.considered), bank.P[s], bank.offset[s], rows.delta
    _distance(offset, delta)
    used, r = np.empty(len(rows.lights), np.int64), 0
    for k in range(len(rows.lights)):
        if rows.lights[k] != s:
            used[r] = k
            r += 1
    used = used[:r]
    Z, G, nu = rows.Z[: 2 * r, : 2 * r], rows.G[: 2 * r], rows.nu[: 2 * r]
    for a in range(r):
        k = used[a]
        i = seen.assignment[rows.lights[k]]
        for axis in range(2):
            _gain_row(k, axis, rows, P, G[2 * a + axis])
            moved = dot_row(delta, rows.h[k], rows.cal[k], axis, rows.lights[k])
            nu[2 * a + axis] = seen.uv[i, axis] - pixels.h[k, axis] - moved
    for a in range(r):
        k = used[a]
        c, cov = rows.lights[k], seen.cov[seen.assignment[rows.lights[k]]]
        for q in range(2 * a, 2 * r):
            Z[q, 2 * a] = dot_row(G[q], rows.h[k], rows.cal[k], 0, c)
            Z[q, 2 * a + 1] = dot_row(G[q], rows.h[k], rows.cal[k], 1, c)
        Z[2 * a, 2 * a] += cov[0, 0]
        Z[2 * a + 1, 2 * a] += cov[1, 0]
        Z[2 * a + 1, 2 * a + 1] += cov[1, 1]
    if math.isnan(factor(Z, 2 * r)):
        return  # nothing is learned from what cannot be solved: the subset stays as wide as it was predicted
    whiten_gains(Z, G)
    w = np.empty(2 * r)
    whiten_innovation(Z, nu, w)
    for q in range(2 * r):
        for i in range(MOVING):
            offset[i] += w[q] * G[q, i]
            a = G[q, i]
            for j in range(n):
                P[i, j] -= a * G[q, j]


@part
def _distance(offset: Array, delta: Array) -> None:
    """Put a subset's pose and twist into its distance `delta` (n,) from the filter."""
    for i in range(MOVING):
        delta[i] = offset[i]


@part
def _plane_of(s: int, lights: Indices, rules: BankRules) -> int:
    """The layer on whose plane all lights of a frame but `s` lie, where that leaves the tilt open; else -1."""
    only, count = -1, 0
    for c in lights:
        if c == s:
            continue
        if only >= 0 and rules.layer[c] != only:
            return -1
        only = rules.layer[c]
        count += 1
    if only < 0 or math.isnan(rules.planes[only, 0]) or (rules.depth_known and count >= 4):
        return -1
    return only


@part
def _prove(station: Lights, state: FilterState, seen: Assigned, work: _Work, proven_m: float, bank: Bank) -> None:
    """Which lights geometry proves: the state blind to one predicts it to `proven_m`, and there it is.

    A light that comes back is unproven until its blind state predicts it as well again.
    """
    n = len(state.x)
    gu, gv, focal = np.empty(n), np.empty(n), math.sqrt(station.lens[1] * station.lens[2])
    for k in range(len(work.lights)):
        c = work.lights[k]
        cov, uv = seen.cov[seen.assignment[c]], seen.uv[seen.assignment[c]]
        _gain_row(k, 0, work, bank.P[c], gu)
        _gain_row(k, 1, work, bank.P[c], gv)
        _distance(bank.offset[c], work.delta)
        h, cal = work.h[k], work.cal[k]
        a, b, d = dot_row(gu, h, cal, 0, c), dot_row(gu, h, cal, 1, c), dot_row(gv, h, cal, 1, c)
        du = uv[0] - h[0] - dot_row(work.delta, h, cal, 0, c)
        dv = uv[1] - h[1] - dot_row(work.delta, h, cal, 1, c)
        p, depth = station.p[c], state.t[2]
        for i in range(3):
            depth += state.R[2, i] * p[i]
        largest = 0.5 * (a + d) + math.sqrt(0.25 * (a - d) * (a - d) + b * b)
        a, b, d = a + cov[0, 0], b + cov[1, 0], d + cov[1, 1]
        there = (d * du * du - 2.0 * b * du * dv + a * dv * dv) / (a * d - b * b) < _PRESENT_NIS
        if there and math.sqrt(max(largest, 0.0)) * depth < proven_m * focal:
            bank.proven[c] = 1
        elif bank.seen[c] == 0:
            bank.proven[c] = 0
    for c in range(len(bank.seen)):
        bank.seen[c] = seen.assignment[c] >= 0

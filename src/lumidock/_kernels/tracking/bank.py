"""A bank of subset states beside the filter: for every light in use a filter that never saw that light.

Whatever a wrong identity did to the filter since the track began, the state that is blind to this light is free of it.
How far the two are apart bounds what the fault may have done (solution separation over the whole history: M. Joerger,
B. Pervan, "Kalman filter-based integrity monitoring against sensor faults", 2013).

All subsets share the filter's association and its linearisation: a subset is how far it is off the filter, and its own
covariance. It branches off the filter when its light is first used. Of a station with very many lights a subset is
blind to a group of them, which bounds a fault of any one of the group.
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
    TWIST,
    FilterState,
    Lights,
    adjoint,
    difference,
    dot_row,
    gains,
    move_covariance,
    row,
)
from lumidock._kernels.tracking.update import Assigned, shrink, whiten_gains, whiten_innovation
from lumidock.datatypes import Array, Indices

_FLATTENINGS = 12  # most linearisations of a start, each at a more frontal view of the plane, which widens its tilt
_FLATTENED = 1.02  # growth of the tilt variance below which they end
_PRESENT_NIS = 9.2  # chi-square, 2 dof, 1 %: a light is where its blind state expects it


class Bank(NamedTuple):
    """S subset states of n states each, for M lights.

    `offset` (S, n): each state minus the filter's. `P` (S, n, n): its covariance. `begun` (S,): 1 once a light that
    it is blind to was used. `plane` (S,): the layer on whose plane its last lights all lay, or -1. `used` (M,): 1 once
    the light was; `seen` (M,): 1 where the last frame had it; `proven` (M,): 1 where geometry has proven it.
    """

    offset: Array
    P: Array
    begun: Indices
    plane: Indices
    used: Indices
    seen: Indices
    proven: Indices


class BankRules(NamedTuple):
    """How the subsets are updated.

    `group` (M,): the subset that is blind to each light. `layer` (M,) of each light and the `planes` (L, 6) of the
    layers. `estimated`: how many states are updated; the others are consider states (S. F. Schmidt, 1966).
    `depth_known`: the track has seen two layers, so that four lights of one hold the tilt. `starting`: the first frame
    of a track; the tilt of a plane is as open as `turn_cov` (3, 3) rad^2 at least. A light that its blind state
    predicts to `proven_m` m, 1 sigma, is proven.
    """

    group: Indices
    layer: Indices
    planes: Array
    estimated: int
    depth_known: bool
    starting: bool
    turn_cov: Array
    proven_m: float


class _Rows(NamedTuple):
    """The K lights of a frame at one linearisation: `lights` (K,), `h` (K, 14) and `cal` (K, 2) as in `row`."""

    lights: Indices
    h: Array
    cal: Array


class _Work(NamedTuple):
    """Room for one subset's update with 2 K pixels and n states: as in `update`, and `w` = L^-1 nu."""

    Z: Array
    G: Array
    nu: Array
    w: Array


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
                offset[i] -= dt * A[i, k] * offset[TWIST + k]
        move_covariance(bank.P[s], A, dt, q_lin, q_ang)


@entry
def attitude_bank(bank: Bank, state: FilterState, Rp: Array, var: Array) -> None:
    """Update all subsets by a sensor's attitude `Rp` (3, 3) of variance `var` (3,) rad^2; `state` is not updated yet.

    The sensor is off by its bias and by as much again of noise, as in `attitude_update`.
    """
    n = len(state.x)
    e, J, g = np.empty(3), np.empty((3, 3)), np.empty(n)
    attitude_error(state.R, Rp, e, J)
    for s in range(len(bank.begun)):
        if bank.begun[s] == 0:
            continue
        offset, P = bank.offset[s], bank.P[s]
        for k in range(3):
            for j in range(n):
                g[j] = J[k, 0] * P[3, j] + J[k, 1] * P[4, j] + J[k, 2] * P[5, j] + P[BIAS + k, j]
            residual = -e[k] - state.x[BIAS + k] - offset[BIAS + k]
            residual -= J[k, 0] * offset[3] + J[k, 1] * offset[4] + J[k, 2] * offset[5]
            S = var[k] + J[k, 0] * g[3] + J[k, 1] * g[4] + J[k, 2] * g[5] + g[BIAS + k]
            for i in range(CALIBRATION):
                offset[i] += g[i] * residual / S
            for i in range(n):
                for j in range(n):
                    if i < CALIBRATION or j < CALIBRATION:
                        P[i, j] -= g[i] * g[j] / S


@entry
def shift_bank(bank: Bank, before: FilterState, after: FilterState) -> None:
    """Keep all subsets where they are while the filter goes from one state to another."""
    n = len(before.x)
    move = np.zeros(n)
    difference(before.R, before.t, after.R, after.t, move)
    for i in range(6, n):
        move[i] = after.x[i] - before.x[i]
    for s in range(len(bank.begun)):
        if bank.begun[s] == 1:
            for i in range(n):
                bank.offset[s, i] -= move[i]


@entry
def update_bank(
    station: Lights,
    before: FilterState,
    after: FilterState,
    seen: Assigned,
    rules: BankRules,
    bank: Bank,
    updated: Bank,
) -> None:
    """Update every subset of a `bank` by the assigned detections that it may see, into `updated`, another bank.

    `before` and `after` are the filter's states before and after its own update. Subsets branch off `before` for the
    lights that are used for the first time. Linearised at a wrong tilt, a single plane would seem to measure its tilt.
    So a subset that sees only one plane is linearised at the most frontal view within three sigmas of its own tilt, as
    in `update`.
    """
    n, pixels = len(after.x), _rows(station, after, seen.assignment)
    r, move, first = 2 * len(pixels.lights), np.zeros(n), np.empty(n)
    work = _Work(np.empty((r, r)), np.empty((r, n)), np.empty(r), np.empty(r))
    difference(before.R, before.t, after.R, after.t, move)
    for i in range(6, n):
        move[i] = after.x[i] - before.x[i]
    for c in range(len(seen.assignment)):
        if seen.assignment[c] >= 0:
            updated.used[c] = updated.begun[rules.group[c]] = 1
    for s in range(len(bank.begun)):
        if updated.begun[s] == 0:
            continue
        P = bank.P[s] if bank.begun[s] == 1 else before.P
        for i in range(n):
            first[i] = (bank.offset[s, i] if bank.begun[s] == 1 else 0.0) - move[i]
        updated.plane[s] = _plane_of(s, pixels.lights, rules)
        if updated.plane[s] < 0:
            _update_one(s, first, P, seen, pixels, pixels, rules, work, updated)
        else:
            _update_flattened(s, first, P, station, after, seen, pixels, rules, work, updated)
    _prove(station, after, seen, pixels, rules, updated)


@part
def _rows(station: Lights, state: FilterState, assignment: Indices) -> _Rows:
    """The rows of all assigned lights that the lens sees at a state."""
    at, k = np.empty(3), 0
    for c in range(len(assignment)):
        k += assignment[c] >= 0
    lights, h, cal = np.empty(k, np.int64), np.empty((k, 14)), np.empty((k, 2))
    k = 0
    for c in range(len(assignment)):
        if assignment[c] >= 0 and row(station, state, c, at, h[k], cal[k]):
            lights[k] = c
            k += 1
    return _Rows(lights[:k], h, cal)


@part
def _update_one(
    s: int,
    first: Array,
    P: Array,
    seen: Assigned,
    pixels: _Rows,
    rows: _Rows,
    rules: BankRules,
    work: _Work,
    updated: Bank,
) -> None:
    """Update one subset of offset `first` and covariance `P` by all lights that it may see, into `updated`.

    Innovations are those of `pixels`, Jacobians those of `rows`.
    """
    offset = updated.offset[s]
    copy_to(first, offset)
    used, m = np.empty(len(rows.lights), np.int64), 0
    for k in range(len(rows.lights)):
        if rules.group[rows.lights[k]] != s:
            used[m] = k
            m += 1
    Z, G, nu, w = work.Z[: 2 * m, : 2 * m], work.G[: 2 * m], work.nu[: 2 * m], work.w[: 2 * m]
    for a in range(m):
        k = used[a]
        c, h, cal = rows.lights[k], rows.h[k], rows.cal[k]
        uv = seen.uv[seen.assignment[c]]
        gains(P, h, cal, c, G[2 * a], G[2 * a + 1])
        nu[2 * a] = uv[0] - pixels.h[k, 0] - dot_row(first, h, cal, 0, c)
        nu[2 * a + 1] = uv[1] - pixels.h[k, 1] - dot_row(first, h, cal, 1, c)
    for a in range(m):
        k = used[a]
        c, h, cal = rows.lights[k], rows.h[k], rows.cal[k]
        cov = seen.cov[seen.assignment[c]]
        for q in range(2 * a, 2 * m):
            Z[q, 2 * a] = dot_row(G[q], h, cal, 0, c)
            Z[q, 2 * a + 1] = dot_row(G[q], h, cal, 1, c)
        Z[2 * a, 2 * a] += cov[0, 0]
        Z[2 * a + 1, 2 * a] += cov[1, 0]
        Z[2 * a + 1, 2 * a + 1] += cov[1, 1]
    if math.isnan(factor(Z, 2 * m)):
        shrink(P, G[:0], rules.estimated, updated.P[s])
        return  # nothing is learned from what cannot be solved: the subset stays as wide as it was predicted
    whiten_gains(Z, G)
    whiten_innovation(Z, nu, w)
    for q in range(2 * m):
        for i in range(rules.estimated):
            offset[i] += w[q] * G[q, i]
    shrink(P, G, rules.estimated, updated.P[s])


@part
def _update_flattened(
    s: int,
    first: Array,
    P: Array,
    station: Lights,
    state: FilterState,
    seen: Assigned,
    pixels: _Rows,
    rules: BankRules,
    work: _Work,
    updated: Bank,
) -> None:
    """Update one subset that sees a single plane; at a start ever flatter until its tilt's covariance grows no more."""
    turn_cov = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            turn_cov[i, j] = rules.turn_cov[i, j] if rules.starting else P[3 + i, 3 + j]
    flat = FilterState(state.R.copy(), state.t.copy(), state.x, state.P)
    for _ in range(_FLATTENINGS if rules.starting else 1):
        set_pose(flat.R, flat.t, state.R, state.t)
        flatten(state.R, state.t, rules.planes[updated.plane[s]], turn_cov, flat.R, flat.t)
        rows = _rows(station, flat, seen.assignment)
        rows = rows if len(rows.lights) == len(pixels.lights) else pixels
        _update_one(s, first, P, seen, pixels, rows, rules, work, updated)
        wider, widest = 0.0, 0.0
        for i in range(3):
            widest += turn_cov[i, i]
            wider += updated.P[s, 3 + i, 3 + i]
            for j in range(3):
                turn_cov[i, j] = updated.P[s, 3 + i, 3 + j]
        if wider < _FLATTENED * widest:
            break


@part
def _plane_of(s: int, lights: Indices, rules: BankRules) -> int:
    """The layer on whose plane all lights lie that a subset may see, where that leaves the tilt open; else -1."""
    only, count = -1, 0
    for c in lights:
        if rules.group[c] == s:
            continue
        if only >= 0 and rules.layer[c] != only:
            return -1
        only = rules.layer[c]
        count += 1
    if only < 0 or math.isnan(rules.planes[only, 0]) or (rules.depth_known and count >= 4):
        return -1
    return only


@part
def _prove(station: Lights, state: FilterState, seen: Assigned, rows: _Rows, rules: BankRules, bank: Bank) -> None:
    """Which lights geometry proves: the state blind to one predicts it to `proven_m`, and there it is.

    A light that comes back is unproven until its blind state predicts it as well again.
    """
    n = len(state.x)
    gu, gv, focal = np.empty(n), np.empty(n), math.sqrt(station.lens[1] * station.lens[2])
    for k in range(len(rows.lights)):
        c, h, cal = rows.lights[k], rows.h[k], rows.cal[k]
        offset, cov, uv = bank.offset[rules.group[c]], seen.cov[seen.assignment[c]], seen.uv[seen.assignment[c]]
        gains(bank.P[rules.group[c]], h, cal, c, gu, gv)
        a, b, d = dot_row(gu, h, cal, 0, c), dot_row(gu, h, cal, 1, c), dot_row(gv, h, cal, 1, c)
        du, dv = uv[0] - h[0] - dot_row(offset, h, cal, 0, c), uv[1] - h[1] - dot_row(offset, h, cal, 1, c)
        depth = state.t[2]
        for i in range(3):
            depth += state.R[2, i] * station.p[c, i]
        largest = 0.5 * (a + d) + math.sqrt(0.25 * (a - d) * (a - d) + b * b)
        a, b, d = a + cov[0, 0], b + cov[1, 0], d + cov[1, 1]
        there = (d * du * du - 2.0 * b * du * dv + a * dv * dv) / (a * d - b * b) < _PRESENT_NIS
        if there and math.sqrt(max(largest, 0.0)) * depth < rules.proven_m * focal:
            bank.proven[c] = 1
        elif bank.seen[c] == 0:
            bank.proven[c] = 0
    for c in range(len(bank.seen)):
        bank.seen[c] = seen.assignment[c] >= 0


@part
def all_proven(bank: Bank, group: Indices, s: int) -> bool:
    """Whether geometry has proven every light in use that a subset is blind to."""
    proven = True
    for c in range(len(group)):
        proven &= group[c] != s or bank.used[c] == 0 or bank.proven[c] == 1
    return proven

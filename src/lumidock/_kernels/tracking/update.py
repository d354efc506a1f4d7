"""The filter's update: all assigned detections of a frame at once."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, fast_part, part
from lumidock._kernels.lens import copy_to, factor
from lumidock._kernels.matching.evidence import assigned_lights
from lumidock._kernels.pose import set_pose
from lumidock._kernels.tracking.slant import flatten
from lumidock._kernels.tracking.track import FilterState, Lights, apply, difference, dot_row, gains, row
from lumidock.datatypes import Array, Indices

_SETTLED = 0.5  # sigmas; a pose that still moves by more in the last step is none


class Assigned(NamedTuple):
    """Detections `uv` (N, 2) px of covariance `cov` (N, 2, 2) px^2, and `assignment` (M,): that of each light or -1."""

    assignment: Indices
    uv: Array
    cov: Array


class UpdateRules(NamedTuple):
    """How an update goes about it.

    The first `estimated` states move; the others are considered: they keep their covariance and lend it to the rest
    (S. F. Schmidt, 1966). It is relinearised up to `steps` times. `tracking`: the prediction holds the pose, instead of
    a first guess. Where all assigned lights lie on one `plane` (6,) (a point and the normal; NaN: they do not), the
    covariance is that of the flattest view within three sigmas of tilt by `turn_cov` (3, 3) rad^2.
    """

    estimated: int
    steps: int
    tracking: bool
    plane: Array
    turn_cov: Array


class _Rows(NamedTuple):
    """Of m assigned `lights` (m,): pixel and Jacobian `h` (m, 14) and `cal` (m, 2) of each, as in `row`.

    `Z` (2 m, 2 m) is the factor L of their innovation's covariance, and `G` (2 m, n) is L^-1 H P.
    """

    lights: Indices
    h: Array
    cal: Array
    Z: Array
    G: Array


@entry
def update(station: Lights, predicted: FilterState, state: FilterState, seen: Assigned, rules: UpdateRules) -> float:
    """Update `state` by all assigned detections at once, in place; the NIS, NaN on failure.

    The pose of `predicted` is the one that `P` belongs to, that of `state` where to linearise first. Seen at a slant by
    mistake, a plane would seem to tell its tilt: so of a single plane the covariance is that of the flattest view; when
    `tracking` the gain is too, so that history rests on perspective and not on the choice between two slants.
    """
    R0, t0, (R, t, x, P) = predicted.R, predicted.t, state
    plane, turn_cov, tracking, estimated = rules.plane, rules.turn_cov, rules.tracking, rules.estimated
    lights, n, slanted = assigned_lights(seen.assignment), len(P), not math.isnan(plane[0])
    m = 2 * len(lights)
    rows = _Rows(lights, np.empty((len(lights), 14)), np.empty((len(lights), 2)), np.empty((m, m)), np.empty((m, n)))
    nu, w, dx, before, x0 = np.empty(m), np.empty(m), np.zeros(n), np.zeros(6), x.copy()
    flat, change = FilterState(R.copy(), t.copy(), x, P), 0.0
    difference(R0, t0, R, t, dx)
    for step in range(rules.steps):
        set_pose(flat.R, flat.t, R, t)
        if slanted and tracking:
            flatten(R, t, plane, turn_cov, flat.R, flat.t)
        if not _whiten(station, flat, seen, rows):
            return np.nan
        if slanted and tracking and not _reproject(station, state, rows):
            return np.nan
        _innovate(seen, dx, rows, nu)
        whiten_innovation(rows.Z, nu, w)
        for j in range(n):
            dx[j] = 0.0
        for r in range(m):
            for j in range(estimated):
                dx[j] += w[r] * rows.G[r, j]
        set_pose(R, t, R0, t0)
        copy_to(x0, x)
        apply(R, t, x, dx)
        change = 0.0  # of the pose since the step before, in sigmas of the prediction
        for j in range(6):
            change = max(change, abs(dx[j] - before[j]) / math.sqrt(P[j, j]))
            before[j] = dx[j]
        if step > 0 and change < 0.02:
            break
        if step == 0 and change < 0.3 and P[3, 3] + P[4, 4] + P[5, 5] < 1e-4:
            break
    if tracking and change > _SETTLED:
        return np.nan
    square = 0.0
    for r in range(m):
        square += w[r] * w[r]
    if slanted:
        set_pose(flat.R, flat.t, R, t)
        flatten(R, t, plane, turn_cov, flat.R, flat.t)
        if not _whiten(station, flat, seen, rows):
            return np.nan
        whiten_innovation(rows.Z, nu, w)
    shrink(P, rows.G, estimated, P)
    return square


@part
def _whiten(station: Lights, state: FilterState, seen: Assigned, rows: _Rows) -> bool:
    """Fill all of `rows` but its lights at a state; False where a light is out of the lens's sight."""
    lights, h, cal, Z, G = rows
    m, at = len(lights), np.empty(3)
    for k in range(m):
        if not row(station, state, lights[k], at, h[k], cal[k]):
            return False
        gains(state.P, h[k], cal[k], lights[k], G[2 * k], G[2 * k + 1])
    for k in range(m):
        c, cov = lights[k], seen.cov[seen.assignment[lights[k]]]
        for r in range(2 * k, 2 * m):
            Z[r, 2 * k] = dot_row(G[r], h[k], cal[k], 0, c)
            Z[r, 2 * k + 1] = dot_row(G[r], h[k], cal[k], 1, c)
        Z[2 * k, 2 * k] += cov[0, 0]
        Z[2 * k + 1, 2 * k] += cov[1, 0]
        Z[2 * k + 1, 2 * k + 1] += cov[1, 1]
    if math.isnan(factor(Z, 2 * m)):
        return False
    whiten_gains(Z, G)
    return True


@fast_part
def whiten_gains(Z: Array, G: Array) -> None:
    """L^-1 H P in place of `G` = H P (2 m, n), with the factor L in the lower triangle of `Z` (2 m, 2 m).

    Four rows at a time: memory, not arithmetic, is what it waits for.
    """
    n = G.shape[1]
    for r in range(len(G)):
        fours = r - r % 4
        for k in range(0, fours, 4):
            a, b, c, d = Z[r, k], Z[r, k + 1], Z[r, k + 2], Z[r, k + 3]
            for j in range(n):
                G[r, j] -= a * G[k, j] + b * G[k + 1, j] + c * G[k + 2, j] + d * G[k + 3, j]
        for k in range(fours, r):
            a = Z[r, k]
            for j in range(n):
                G[r, j] -= a * G[k, j]
        a = 1.0 / Z[r, r]
        for j in range(n):
            G[r, j] *= a


@part
def _reproject(station: Lights, state: FilterState, rows: _Rows) -> bool:
    """Put the pixels of another state into `rows`, whose Jacobians stay; False where the lens does not see a light."""
    at, h, cal = np.empty(3), np.empty(14), np.empty(2)
    for k in range(len(rows.lights)):
        if not row(station, state, rows.lights[k], at, h, cal):
            return False
        rows.h[k, 0], rows.h[k, 1] = h[0], h[1]
    return True


@part
def _innovate(seen: Assigned, dx: Array, rows: _Rows, nu: Array) -> None:
    """Innovation `nu` (2 m,) against the prediction, from which the state is `dx` (n,) away."""
    for k in range(len(rows.lights)):
        c, h, cal = rows.lights[k], rows.h[k], rows.cal[k]
        i = seen.assignment[c]
        nu[2 * k] = seen.uv[i, 0] - h[0] + dot_row(dx, h, cal, 0, c)
        nu[2 * k + 1] = seen.uv[i, 1] - h[1] + dot_row(dx, h, cal, 1, c)


@part
def whiten_innovation(Z: Array, nu: Array, w: Array) -> None:
    """Solve Z w = nu for a lower triangle."""
    for r in range(len(nu)):
        s = nu[r]
        for k in range(r):
            s -= Z[r, k] * w[k]
        w[r] = s / Z[r, r]


@fast_part
def shrink(P: Array, G: Array, estimated: int, out: Array) -> None:
    """Take the information of an update out of `P` (n, n), but not from what is only considered; `G` (2 m, n).

    The covariance goes to `out` (n, n), which may be `P` itself.
    """
    fours = len(G) - len(G) % 4
    for i in range(len(P)):
        end = i + 1 if i < estimated else estimated
        for j in range(i + 1):
            out[i, j] = P[i, j]
        for r in range(0, fours, 4):
            a, b, c, d = G[r, i], G[r + 1, i], G[r + 2, i], G[r + 3, i]
            for j in range(end):
                out[i, j] -= a * G[r, j] + b * G[r + 1, j] + c * G[r + 2, j] + d * G[r + 3, j]
        for r in range(fours, len(G)):
            a = G[r, i]
            for j in range(end):
                out[i, j] -= a * G[r, j]
        for j in range(i):
            out[j, i] = out[i, j]

"""Poses from two assigned lights and the expected attitude, and which other lights are in place under them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import part
from lumidock._kernels.lens import invert6
from lumidock._kernels.matching.evidence import SCAN_WORK, Problem, SearchRules, innovation, survey_var
from lumidock._kernels.matching.gates import Expected, occupied
from lumidock._kernels.pose import light_row
from lumidock.datatypes import Array, Indices

SUPPORT, MERIT, LIGHTS, FIRST, SECOND, DEPTH, ROLL = range(7)  # columns of a list of tries
MERITS = 8  # classes of tries with as many lights in place, by prior and looks
_MERIT_STEP = 2.0  # of twice the log probability, from one class to the next; the last holds all of the prior's tail


class Pair(NamedTuple):
    """Detections `i` and `j` of lights `a` and `b`, with the depth `z` m of `a` and the roll rad that this leads to."""

    a: int
    b: int
    i: int
    j: int
    z: float
    roll: float


class PairPose(NamedTuple):
    """A pose of which two pixels and the expected attitude are known.

    Of each detection the light, `taken` (N,) or -1, and the pose `R`, `t`. `prior_info` (3, 6) is the information of
    the prior; `H` and `L` (6, 6) are work space.
    """

    taken: Indices
    R: Array
    t: Array
    prior_info: Array
    H: Array
    L: Array


@part
def new_pair_pose(problem: Problem) -> PairPose:
    """Room for a pose under which no detection is taken yet."""
    taken = np.full(len(problem.uv), -1, np.int64)
    open_ = np.zeros((3, 6))
    _open_attitude(problem, open_)
    return PairPose(taken, np.empty((3, 3)), np.empty(3), open_, np.empty((6, 6)), np.empty((6, 6)))


@part
def _open_attitude(problem: Problem, open_: Array) -> None:
    """Add the information (3, 6) that the attitude prior has of a pose; of rotation, the last three columns.

    At the expected attitude its Jacobian is, whatever the roll, -y, x and -z of `cam` in dock axes.
    """
    for m in range(3):
        axis = 1 - m if m < 2 else 2
        for k in range(3):
            for o in range(3):
                open_[k, 3 + o] += problem.info[m] * problem.Rp[k, axis] * problem.Rp[o, axis]


@part
def pair_poses(
    lights: tuple[int, int], least: int, most_work: int, problem: Problem, pose: PairPose, expected: Expected
) -> Array:
    """All pairs of detections that two `lights` of a layer may have made, rows (K, 7).

    A row has how many other lights of the layer are in place (`SUPPORT`), the `MERIT` of the pair among those with as
    many, the two lights as a * M + b, the two detections, the depth of the first light m and the roll rad. Pairs with
    fewer than `least` in place are left out, and all beyond `most_work`.
    """
    (a, b), n, taken, m = lights, len(problem.uv), pose.taken, len(problem.p)
    d, sols, rows, found = np.empty(3), np.empty((2, 2)), np.empty((64, 7)), 0
    for k in range(3):  # R_cam_dock of the prior is Rp^T
        d[k] = 0.0
        for o in range(3):
            d[k] += problem.Rp[o, k] * (problem.p[b, o] - problem.p[a, o])
    for i in range(n):
        problem.work[0] += n // SCAN_WORK
        for j in range(n):
            if i == j or not (problem.ray[i, 2] > 0.0 and problem.ray[j, 2] > 0.0):
                continue
            for sol in range(_pair_pose(d, problem.ray[i], problem.ray[j], problem.rules, sols)):
                if problem.work[0] > most_work:
                    return rows[:found]
                pair = Pair(a, b, i, j, sols[sol, 0], sols[sol, 1])
                know_pair(pair, problem, pose, expected.rows[a], expected.P)
                taken[i], taken[j] = a, b
                support = in_place(pair, least, problem, pose, expected)
                taken[i], taken[j] = -1, -1
                if support >= least:
                    if found == len(rows):
                        rows = np.concatenate((rows, np.empty(rows.shape)))
                    rows[found, SUPPORT], rows[found, MERIT] = support, _merit(pair, problem)
                    rows[found, LIGHTS], rows[found, FIRST], rows[found, SECOND] = a * m + b, i, j
                    rows[found, DEPTH], rows[found, ROLL] = pair.z, pair.roll
                    found += 1
    return rows[:found]


@part
def _merit(pair: Pair, problem: Problem) -> int:
    """How well a pair fits the expected roll and looks like its layer, from 0 to `MERITS` - 1."""
    layer = problem.layer[pair.a]
    unlike = pair.roll * pair.roll * problem.info[2]
    unlike -= 2.0 * (problem.like[pair.i, layer] + problem.like[pair.j, layer])
    return MERITS - 1 - int(min(max(unlike / _MERIT_STEP, 0.0), MERITS - 1.0))


@part
def pair_of(row: Array, lights: int) -> Pair:
    """The pair of a row (7,) of tries, of a station of so many `lights`."""
    both = int(row[LIGHTS])
    return Pair(both // lights, both % lights, int(row[FIRST]), int(row[SECOND]), row[DEPTH], row[ROLL])


@part
def _pair_pose(d: Array, ray_i: Array, ray_j: Array, rules: SearchRules, out: Array) -> int:
    """Depth of the first light and roll that put two lights `d` (3,) apart in the prior's `cam` axes on two rays.

    Fills up to two rows of `out` (2, 2); returns how many lie within the gates.
    """
    xi, yi = ray_i[0] / ray_i[2], ray_i[1] / ray_i[2]
    xj, yj = ray_j[0] / ray_j[2], ray_j[1] / ray_j[2]
    dx, dy, across = xj - xi, yj - yi, d[0] * d[0] + d[1] * d[1]
    A = dx * dx + dy * dy
    B = d[2] * (dx * xj + dy * yj)
    C = d[2] * d[2] * (xj * xj + yj * yj) - across
    root = B * B - A * C
    if A <= 0.0 or root < 0.0:
        return 0
    root = math.sqrt(root)
    found = 0
    for sign in (1.0, -1.0):
        z = (-B + sign * root) / A
        if not rules.near_m < z < rules.far_m or z + d[2] < rules.near_m:
            continue
        ex, ey = z * dx + d[2] * xj, z * dy + d[2] * yj
        along, (least, largest) = d[0] * ex + d[1] * ey, rules.roll_cosines
        if along > least * across or along < largest * across:  # of both vectors `across` is the squared length
            continue
        out[found, 0], out[found, 1] = z, math.atan2(d[0] * ey - d[1] * ex, along)
        found += 1
    return found


@part
def know_pair(pair: Pair, problem: Problem, pose: PairPose, h: Array, P: Array) -> None:
    """Fill `pose` and its covariance `P` (6, 6) from two lights and the expected attitude; `h` (14,) is work space."""
    a, b, i, j, z, roll = pair
    R, t = pose.R, pose.t
    problem.work[0] += 1
    _pose_of(problem.Rp, roll, z, problem.ray[i], problem.p[a], R, t)
    H = pose.H
    for m in range(3):
        for o in range(6):
            H[m, o], H[3 + m, o] = 0.0, pose.prior_info[m, o]
    for k in range(2):
        c, d = (a, i) if k == 0 else (b, j)
        if light_row(problem.lens, R, t, problem.p[c], h):
            w = 1.0 / (problem.var[d] + survey_var(problem.lens, R, t, problem.p[c], problem.survey_m2[c]))
            for m in range(6):
                for o in range(m + 1):
                    H[m, o] += w * (h[2 + m] * h[2 + o] + h[8 + m] * h[8 + o])
    invert6(H, pose.L, P)


@part
def _pose_of(Rp: Array, roll: float, z: float, ray: Array, p: Array, R: Array, t: Array) -> None:
    """Pose of the prior attitude turned by `roll`, with the light at `p` at depth `z` on `ray`."""
    c, s = math.cos(roll), math.sin(roll)
    for k in range(3):
        R[0, k] = c * Rp[k, 0] - s * Rp[k, 1]
        R[1, k] = s * Rp[k, 0] + c * Rp[k, 1]
        R[2, k] = Rp[k, 2]
    for k in range(3):
        t[k] = z * ray[k] / ray[2] - (R[k, 0] * p[0] + R[k, 1] * p[1] + R[k, 2] * p[2])


@part
def in_place(pair: Pair, least: int, problem: Problem, pose: PairPose, expected: Expected) -> int:
    """How many other lights of the layer have a free detection in their gate; fills `expected` with where they are.

    Ends early where `least` can no longer be reached. One function with its arrays at hand: it is half of all work.
    """
    loosest, by_u = problem.loosest, problem.by_u
    lens, p, layer, survey_m2, uv, var = (
        problem.lens,
        problem.p,
        problem.layer,
        problem.survey_m2,
        problem.uv,
        problem.var,
    )
    rows, sought, extra, P, R, t, taken = (
        expected.rows,
        expected.sought,
        expected.extra,
        expected.P,
        pose.R,
        pose.t,
        pose.taken,
    )
    gate, bend, a, b = problem.rules.pair_gate, problem.rules.bend, pair.a, pair.b
    mu, mv = 0.5 * (uv[pair.i, 0] + uv[pair.j, 0]), 0.5 * (uv[pair.i, 1] + uv[pair.j, 1])
    support, left = 0, -2
    for c in range(len(p)):
        left += layer[c] == layer[a]
    for c in range(len(p)):
        sought[c] = False
        if c == a or layer[c] != layer[a] or c == b:  # noqa: SIM109 - slow in numba
            continue
        if support + left < least:
            break
        left -= 1
        h, S = rows[c], expected.S[c]
        if not light_row(lens, R, t, p[c], h):
            continue
        sought[c] = True
        du, dv = h[0] - mu, h[1] - mv
        extra[c] = survey_var(lens, R, t, p[c], survey_m2[c]) + bend * (du * du + dv * dv)
        innovation(h, P, extra[c], S)
        support += occupied(h[0], h[1], S, taken, uv, var, loosest, by_u, gate)
    return support

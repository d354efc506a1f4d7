"""The log evidence of one association of a frame's detections with lights, its pose integrated out.

For an association A of K of the N detections with lights, over the hypothesis "all N are clutter":

    log E(A) = sum over assigned lights c [ log p_D + log l(i_c, layer_c) ]        `detect`, `like`
             + sum over layers [ log of the probability of its missed lights ]     `detect`, `absent`
             - log_clutter[K]                                                      what clutter would have explained
             + log integral over poses of prod_c N(uv_i; h_c(T), var_i + survey) p(T)

The integral is Laplace's: at the most probable pose T of cost chi^2 (prior included) and normal matrix H,

    3 log 2 pi + 1/2 log |info| - 3/2 log 2 pi - chi^2 / 2 - 1/2 log |H| - sum_c log(2 pi var_c) + log p(t)

`log_det` is log |H|, `cost` chi^2, `log_var` the sum of log(2 pi var_c), `info` the information of the attitude prior.
Source: D. MacKay, "Information Theory, Inference, and Learning Algorithms", 2003, chapter 27.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import part
from lumidock._kernels.lens import copy_to, inside
from lumidock._kernels.pose import light_row, refine, set_pose
from lumidock._kernels.visibility import EDGE_PX, faces
from lumidock.datatypes import Array, Indices

LOG_2PI = math.log(2.0 * math.pi)
HUGE = 1e300  # as a log evidence, negative: impossible
_ELSEWHERE = 8.0  # log odds of two priors that one solution under both cannot reach
STEPS = 6  # of Gauss-Newton, at most; from a pose that is nearly right two or three are enough
FIT_WORK = 4  # units of work that a fit counts for; one is a pose of two pixels, checked against a layer's lights
SCAN_WORK = 48  # detections that are looked through for a unit of work


class SearchRules(NamedTuple):
    """The scalars of the acquisition's model.

    `log_volume`: log of the volume m^3 of the view cone up to `far_m`. `detect`: probability that a light in view is
    detected; `absent`: that a whole layer is not seen. `gate`, `pair_gate`: chi-square (2 dof) of a detection for a
    light that is placed by three lights or more, by two and the attitude prior. `near_m`, `far_m`: distances of a
    light. `roll_cosines`: of the least and of the largest roll off the prior. `bend`: variance per px^2 of separation
    that the unknown tilt adds. `steady`: share of vehicles that hold the expected attitude well. `log_prior`: log
    probability of such rolls.
    """

    log_volume: float
    detect: float
    absent: float
    gate: float
    pair_gate: float
    near_m: float
    far_m: float
    roll_cosines: tuple[float, float]
    bend: float
    steady: float
    log_prior: float


class Problem(NamedTuple):
    """The acquisition of one frame: the station's lights, the detections, and what is expected of the attitude.

    Flat, because numba counts the references to every array of a tuple that it takes out of another. M lights: lens
    (16,), positions `p` (M, 3) m, `layer` (M,), `axis` (M, 3), `survey_m2` (M,) variance of a position, and the `rank`
    (M,) of each in its layer. N detections: `uv` (N, 2) px and their order `by_u` (N,) by column, `ray` (N, 3), `var`
    (N,) px^2 and the largest of them, log likelihood ratio of each for each layer `like` (N, L), and `log_clutter`
    (N + 1,), the log probability of so many as clutter. The attitude prior: `Rp` (3, 3) = R_dock_cam, `info` (3,)
    1/rad^2 of tilt toward cam x, toward cam y and of roll; `steady` (3,) the same of a vehicle that holds its attitude
    well. `work` (1,): units of work done so far, counted in place; `FIT_WORK` says what a unit is.
    """

    lens: Array
    p: Array
    layer: Indices
    axis: Array
    survey_m2: Array
    rank: Indices
    uv: Array
    by_u: Indices
    ray: Array
    var: Array
    loosest: float
    like: Array
    log_clutter: Array
    Rp: Array
    info: Array
    steady: Array
    rules: SearchRules
    work: Indices


class Candidate(NamedTuple):
    """A hypothesis, changed in place: the detection of each light or -1, `assignment` (M,), and T_cam_dock `R`, `t`."""

    assignment: Indices
    R: Array
    t: Array


@part
def copied(one: Candidate) -> Candidate:
    """The same hypothesis in arrays of its own."""
    return Candidate(one.assignment.copy(), one.R.copy(), one.t.copy())


@part
def put(target: Candidate, source: Candidate) -> None:
    """Overwrite a hypothesis, in place."""
    copy_to(source.assignment, target.assignment)
    set_pose(target.R, target.t, source.R, source.t)


@part
def keep(e: float, best: float, one: Candidate, better: Candidate) -> float:
    """Remember in `better`, in place, a hypothesis of log evidence `e` that beats the best; the better of the two."""
    if not e > best:
        return best
    put(better, one)
    return e


@part
def survey_var(lens: Array, R: Array, t: Array, p: Array, survey_m2: float) -> float:
    """Variance px^2 that the survey error of a light at `p` (3,) adds."""
    z = max(R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + t[2], 0.05)
    return survey_m2 * lens[1] * lens[2] / (z * z)


@part
def fit(one: Candidate, problem: Problem, info: Array, steps: int, H: Array, L: Array) -> tuple[float, float, float]:
    """Most probable pose of the assigned lights, in place: cost, log det H, and the sum of log(2 pi variance)."""
    assignment, R, t = one
    problem.work[0] += FIT_WORK
    used, log_var = assigned_lights(assignment), 0.0
    ps, uvs, vs = np.empty((len(used), 3)), np.empty((len(used), 2)), np.empty(len(used))
    for k in range(len(used)):
        c = used[k]
        copy_to(problem.p[c], ps[k])
        copy_to(problem.uv[assignment[c]], uvs[k])
        vs[k] = problem.var[assignment[c]] + survey_var(problem.lens, R, t, problem.p[c], problem.survey_m2[c])
        log_var += LOG_2PI + math.log(vs[k])
    cost, log_det = refine(problem.lens, ps, uvs, vs, R, t, problem.Rp, info, steps, H, L)
    return cost, log_det, log_var


@part
def log_evidence(one: Candidate, problem: Problem, info: Array, fitted: tuple[float, float, float]) -> float:
    """Log evidence of a hypothesis over "all clutter", the pose integrated out by Laplace's method."""
    assignment, R, t = one
    rules = problem.rules
    cost, log_det, log_var = fitted
    if math.isnan(cost) or math.isnan(log_det):
        return -HUGE
    total = 1.5 * LOG_2PI - 0.5 * log_det - 0.5 * cost - log_var - problem.log_clutter[n_assigned(assignment)]
    distance = max(math.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]), rules.near_m)
    # position prior: half flat inside the view cone, half flat in the logarithm of the distance
    near = (rules.far_m / distance) ** 3 / (3.0 * math.log(rules.far_m / rules.near_m))
    total += math.log(0.5 + 0.5 * near) - rules.log_volume + rules.log_prior
    for k in range(3):
        total += 0.5 * math.log(info[k])
    layers = problem.like.shape[1]
    matched, missed = np.zeros(layers, np.int64), np.zeros(layers, np.int64)
    h = np.empty(14)
    for c in range(len(assignment)):
        i, layer = assignment[c], problem.layer[c]
        if i >= 0:
            total += math.log(rules.detect) + problem.like[i, layer]
            matched[layer] += 1
        elif light_row(problem.lens, R, t, problem.p[c], h) and inside(problem.lens, h[0], h[1], EDGE_PX):
            missed[layer] += faces(R, t, problem.p[c], problem.axis[c])
    for k in range(layers):
        miss = missed[k] * math.log(1.0 - rules.detect)
        if matched[k] == 0 and missed[k] > 0:
            miss = math.log(rules.absent + (1.0 - rules.absent) * math.exp(miss))
        total += miss
    return total


@part
def evidence(one: Candidate, problem: Problem, steps: int, H: Array, L: Array) -> float:
    """Log evidence of an association whose pose is solved anew, in place, under the whole attitude prior.

    The prior is a mixture: a share `steady` of vehicles holds its attitude as `problem.steady` says. The pose and the
    normal matrix `H` are those under the wide part, unless it leads to another solution that is out of the question.
    """
    wide = solved(one, problem, problem.info, steps, H, L)
    steady = problem.rules.steady
    if steady <= 0.0 or wide <= -HUGE:
        return wide
    held, H_held = copied(one), np.empty((6, 6))
    narrow = solved(held, problem, problem.steady, steps, H_held, L)
    if narrow > wide + _ELSEWHERE:
        put(one, held)
        for k in range(6):
            copy_to(H_held[k], H[k])
    return log_add(wide + math.log(1.0 - steady), narrow + math.log(steady))


@part
def solved(one: Candidate, problem: Problem, info: Array, steps: int, H: Array, L: Array) -> float:
    """Log evidence of an association whose pose is solved anew, in place, under an attitude prior of `info` (3,)."""
    return log_evidence(one, problem, info, fit(one, problem, info, steps, H, L))


@part
def log_add(a: float, b: float) -> float:
    """Logarithm of the sum of two numbers from their logarithms."""
    high, low = max(a, b), min(a, b)
    return high if low < high - 40.0 else high + math.log1p(math.exp(low - high))


@part
def innovation(h: Array, P: Array, extra: float, S: Array) -> None:
    """S (3,) = uu, uv, vv of the predicted pixel's covariance, `extra` px^2 on its diagonal."""
    S[0], S[1], S[2] = extra, 0.0, extra
    for i in range(6):
        a, b = 0.0, 0.0
        for j in range(6):
            a += P[i, j] * h[2 + j]
            b += P[i, j] * h[8 + j]
        S[0] += h[2 + i] * a
        S[1] += h[2 + i] * b
        S[2] += h[8 + i] * b


@part
def n_assigned(assignment: Indices) -> int:
    """How many lights have a detection."""
    n = 0
    for c in range(len(assignment)):
        n += assignment[c] >= 0
    return n


@part
def assigned_lights(assignment: Indices) -> Indices:
    """The lights (K,) that have a detection."""
    lights, n = np.empty(n_assigned(assignment), np.int64), 0
    for c in range(len(assignment)):
        if assignment[c] >= 0:
            lights[n] = c
            n += 1
    return lights


@part
def assigned_points(assignment: Indices, p: Array) -> Array:
    """Positions (K, 3) of the lights that have a detection."""
    lights = assigned_lights(assignment)
    points = np.empty((len(lights), 3))
    for k in range(len(lights)):
        copy_to(p[lights[k]], points[k])
    return points

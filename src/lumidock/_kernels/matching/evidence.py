"""How probable a naming of one frame's detections is, with the pose integrated out."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels import constant
from lumidock._kernels.compiling import entry, part
from lumidock._kernels.lens import copy_to, inside
from lumidock._kernels.pose import light_row, refine, set_pose
from lumidock.datatypes import Array, Indices

# entries of the parameters `q`
LOG_VOLUME, DETECT, ABSENT, GATE, NEAR_M, FAR_M, ROLL_GATE, BEND, STEADY, PAIR_GATE = range(10)
LOG_2PI = math.log(2.0 * math.pi)
HUGE = 1e300
_ELSEWHERE = 8.0  # log odds of two priors that one solution under both cannot reach
_EDGE_PX, _SHINES = 3.0, 0.1  # a light this near the edge, or seen this flat (cosine), may be missing at no cost
STEPS = constant(6)  # of Gauss-Newton, at most


class Scene(NamedTuple):
    """One frame: the lights of the station as a lens sees it, the detections, and what is expected of the attitude.

    Flat, because numba counts the references to every array of a tuple that it takes out of another. M lights: lens
    (16,), positions `p` (M, 3) m, `layer` (M,), `axis` (M, 3), `survey_m2` (M,) variance of a position, and the `rank`
    (M,) of each in its layer. N detections: `uv` (N, 2) px and their order `by_u` (N,) by column, `ray` (N, 3), `var`
    (N,) px^2 and the largest of them, log likelihood ratio of each for each layer `like` (N, L), and `log_clutter`
    (N + 1,), the log price of naming so many. The attitude: `Rp` (3, 3) = R_dock_cam, `info` (3,) 1/rad^2 of tilt, tilt
    and roll, `steady` (3,) the same of a vehicle that holds its attitude well, and the parameters `q`.
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
    q: Array


class Naming(NamedTuple):
    """A hypothesis: `name` (M,), the detection that each light is given, or -1; and its pose `R`, `t` of T_cam_dock."""

    name: Indices
    R: Array
    t: Array


@part
def copied(one: Naming) -> Naming:
    """The same hypothesis in arrays of its own."""
    return Naming(one.name.copy(), one.R.copy(), one.t.copy())


@part
def put(target: Naming, source: Naming) -> None:
    """Overwrite a hypothesis, in place."""
    copy_to(source.name, target.name)
    set_pose(target.R, target.t, source.R, source.t)


@part
def keep(e: float, best: float, one: Naming, better: Naming) -> float:
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
def fit(one: Naming, scene: Scene, info: Array, steps: int, H: Array, L: Array) -> tuple[float, float, float]:
    """Most probable pose of the named lights, in place: cost, log det H, and the sum of log(2 pi variance)."""
    name, R, t = one
    used, log_var = named_lights(name), 0.0
    ps, uvs, vs = np.empty((len(used), 3)), np.empty((len(used), 2)), np.empty(len(used))
    for k in range(len(used)):
        c = used[k]
        copy_to(scene.p[c], ps[k])
        copy_to(scene.uv[name[c]], uvs[k])
        vs[k] = scene.var[name[c]] + survey_var(scene.lens, R, t, scene.p[c], scene.survey_m2[c])
        log_var += LOG_2PI + math.log(vs[k])
    cost, log_det = refine(scene.lens, ps, uvs, vs, R, t, scene.Rp, info, steps, H, L)
    return cost, log_det, log_var


@part
def log_evidence(one: Naming, scene: Scene, info: Array, fitted: tuple[float, float, float]) -> float:
    """Log evidence of a hypothesis over "all clutter", the pose integrated out by Laplace's method."""
    name, R, t = one
    q = scene.q
    cost, log_det, log_var = fitted
    if math.isnan(cost) or math.isnan(log_det):
        return -HUGE
    total = 1.5 * LOG_2PI - 0.5 * log_det - 0.5 * cost - log_var - scene.log_clutter[named(name)]
    distance = max(math.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]), q[NEAR_M])
    # position prior: half flat inside the view cone, half flat in the logarithm of the distance
    near = (q[FAR_M] / distance) ** 3 / (3.0 * math.log(q[FAR_M] / q[NEAR_M]))
    total += math.log(0.5 + 0.5 * near) - q[LOG_VOLUME]
    for k in range(3):
        total += 0.5 * math.log(info[k])
    layers = scene.like.shape[1]
    matched, missed = np.zeros(layers, np.int64), np.zeros(layers, np.int64)
    h = np.empty(14)
    for c in range(len(name)):
        i, layer = name[c], scene.layer[c]
        if i >= 0:
            total += math.log(q[DETECT]) + scene.like[i, layer]
            matched[layer] += 1
        elif light_row(scene.lens, R, t, scene.p[c], h) and inside(scene.lens, h[0], h[1], _EDGE_PX):
            missed[layer] += _shines(scene, R, t, c)
    for k in range(layers):
        miss = missed[k] * math.log(1.0 - q[DETECT])
        if matched[k] == 0 and missed[k] > 0:
            miss = math.log(q[ABSENT] + (1.0 - q[ABSENT]) * math.exp(miss))
        total += miss
    return total


@part
def _shines(scene: Scene, R: Array, t: Array, c: int) -> bool:
    """Whether light `c` sends its light toward the camera, which stands at -R^T t."""
    norm, along = 0.0, 0.0
    for k in range(3):
        away = -(R[0, k] * t[0] + R[1, k] * t[1] + R[2, k] * t[2]) - scene.p[c, k]
        norm += away * away
        along += away * scene.axis[c, k]
    return along > _SHINES * math.sqrt(norm)


@part
def evidence(one: Naming, scene: Scene, steps: int, H: Array, L: Array) -> float:
    """Log evidence of a naming whose pose is solved anew, in place, under the whole attitude prior.

    The prior is a mixture: a share `STEADY` of vehicles holds its attitude as `scene.steady` says. The pose and the
    normal matrix `H` are those under the wide part, unless it leads to another solution that is out of the question.
    """
    wide = solved(one, scene, scene.info, steps, H, L)
    steady = scene.q[STEADY]
    if steady <= 0.0 or wide <= -HUGE:
        return wide
    held, H_held = copied(one), np.empty((6, 6))
    narrow = solved(held, scene, scene.steady, steps, H_held, L)
    if narrow > wide + _ELSEWHERE:
        put(one, held)
        for k in range(6):
            copy_to(H_held[k], H[k])
    return log_add(wide + math.log(1.0 - steady), narrow + math.log(steady))


@part
def solved(one: Naming, scene: Scene, info: Array, steps: int, H: Array, L: Array) -> float:
    """Log evidence of a naming whose pose is solved anew, in place, under an attitude prior of `info` (3,)."""
    return log_evidence(one, scene, info, fit(one, scene, info, steps, H, L))


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
def named(name: Indices) -> int:
    """How many lights a naming names."""
    n = 0
    for c in range(len(name)):
        n += name[c] >= 0
    return n


@part
def named_lights(name: Indices) -> Indices:
    """The lights (K,) that a naming names."""
    lights, n = np.empty(named(name), np.int64), 0
    for c in range(len(name)):
        if name[c] >= 0:
            lights[n] = c
            n += 1
    return lights


@part
def named_points(name: Indices, p: Array) -> Array:
    """Positions (K, 3) of the lights that a naming names."""
    lights = named_lights(name)
    points = np.empty((len(lights), 3))
    for k in range(len(lights)):
        copy_to(p[lights[k]], points[k])
    return points


@entry
def weigh(
    uv: Array,
    radius: Array,
    p_rear: Array,
    is_rear: Indices,
    trust: float,
    strange: tuple[float, float, float],
    cov: Array,
    p_light: Array,
    like: Array,
    var: Array,
) -> float:
    """Fill `like` (N, L), softened log likelihood ratios, and `var` (N,) px^2 per axis; the area px^2 of all spots.

    `p_light` (N,) becomes 1 where it is NaN. `cov` (N, 2, 2) grows by a `strange` share of the radius, or of its bound,
    where `p_light` is less than this much.
    """
    low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
    layers, (share, most, usual) = len(is_rear), strange
    for i in range(len(uv)):
        if math.isnan(p_light[i]):
            p_light[i] = 1.0
        own = radius[i] if radius[i] < most else most
        wider = (share * max(1.0 - p_light[i] / usual, 0.0) * own) ** 2
        cov[i, 0, 0] += wider
        cov[i, 1, 1] += wider
        low_u, high_u = min(low_u, uv[i, 0]), max(high_u, uv[i, 0])
        low_v, high_v = min(low_v, uv[i, 1]), max(high_v, uv[i, 1])
        var[i] = 0.5 * (cov[i, 0, 0] + cov[i, 1, 1])
        lamp = math.log(min(max(2.0 * p_light[i], 0.05), 1.0))
        p = 0.5 if math.isnan(p_rear[i]) or layers == 1 else 0.5 + trust * (p_rear[i] - 0.5)
        for k in range(layers):
            like[i, k] = lamp + math.log(2.0 * (p if is_rear[k] == 1 or layers == 1 else 1.0 - p))
    return (high_u - low_u) * (high_v - low_v)

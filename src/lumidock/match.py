"""Cold start: which detection is which light, over all layers at once, with what else it could be.

The model: spurious spots of geometric number, a detection probability per light, Gaussian centres, a prior on the
attitude, one on the position that is half flat in the view cone and half flat in log distance. The score of a naming
is its log evidence over "all clutter", with the pose integrated out by Laplace's method (D. MacKay, "Information
Theory, Inference, and Learning Algorithms", ch. 27).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lumidock._kernels.matching import evidence as kernel
from lumidock._kernels.matching.evidence import Naming, Scene
from lumidock._kernels.matching.rivals import other_pose, rivals
from lumidock._kernels.matching.search import Goal, Listed, search
from lumidock.camera import Camera
from lumidock.config import MatchConfig, PriorConfig
from lumidock.datatypes import Array, Attitude, Detections, Indices
from lumidock.station import Station

_HEAD_ON = np.diag([1.0, -1.0, -1.0])
_MIRROR = np.array([1.0, -1.0, 1.0])  # the water's surface is level, and so is dock x, z
_NONE = -1e300
_MAX_RELABELLINGS = 4
_LAMP, _STRANGE = 0.5, 0.15  # of the probabilities to be one
_RADIUS_PX = 3.0  # of a spot that comes without one; a larger one says no more
_OPEN_ROLL = math.radians(45.0)  # 1 sigma; of a roll less known than this a steady vehicle says nothing
_FLAT = 0.05  # a layer less thick than this share of its width is a plane


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A station as the search wants it: M lights, the order in which pairs are tried, and what is unseen before each.

    `unseen` (S,) is the most lights of one layer in a naming without the pairs before; `survey_m2` (M,) the
    variance of a position, `rank` (M,) the place of a light in its layer's order.
    """

    lens: Array
    p_dock: Array
    layer: Indices
    axis: Array
    survey_m2: Array
    rank: Indices
    pairs: Indices
    unseen: Indices
    n_layers: int
    is_rear: Indices
    planes: Array
    log_volume: float
    sigma_focal: float

    def count(self, name: Indices) -> tuple[int, ...]:
        """How many lights of each layer a naming (M,) names."""
        return tuple(np.bincount(self.layer[name >= 0], minlength=self.n_layers).tolist())


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """An attitude expected.

    `R_dock_cam` (3, 3); 1/variance (3,) of tilt toward cam x, toward cam y, and of roll; whether a sensor measured it.
    """

    R_dock_cam: Array
    info: Array
    measured: bool


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A naming (M,): the detection of each light or -1; the pose that fits it best; its log evidence over clutter."""

    name: Indices
    T_cam_dock: Array
    log_evidence: float


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """The best hypothesis first, without its doubtful names, and all that fit, with them.

    `margin` is the log odds of its names against all others; `certainty` what of it may stand for the stated risk: less
    among spots that crowd around them, and no more than a lock needs where too few names are each beyond doubt.
    `others` are the other poses that the best names fit, where a plane leaves two. `reason` says why it is no answer.
    """

    candidates: tuple[Hypothesis, ...]
    others: tuple[Hypothesis, ...]
    margin: float
    reason: str = ""
    certainty: float = 0.0


def plan(station: Station, camera: Camera, config: MatchConfig) -> Plan:
    """Prepare a station and a camera for the search."""
    front_first = station.layers_front_to_rear()
    behind = np.array([front_first.index(name) for name in station.layers])  # layers in front of each
    survey_m2 = station.sigma_light_m**2 + (behind > 0)[station.layer] * 2.0 * station.sigma_layer_m**2
    rank, pairs, unseen = _pair_order(station)
    size = np.array([camera.width, camera.height]) / camera.focal_px
    volume = float(size.prod()) * config.far_m**3 / 3.0
    is_rear = ((behind == len(front_first) - 1) & (behind > 0)).astype(np.int64)  # a lone layer is the front one
    return Plan(
        camera.lens(),
        np.ascontiguousarray(station.p_dock),
        station.layer,
        station.axis,
        survey_m2,
        rank,
        pairs,
        unseen,
        len(station.layers),
        is_rear,
        _planes(station),
        math.log(volume),
        station.sigma_focal,
    )


def _planes(station: Station) -> Array:
    """A point and the normal (L, 6) of each layer's plane, NaN for a layer with depth."""
    planes = np.full((len(station.layers), 6), np.nan)
    for k, p in enumerate(station.p_dock[station.lights_of(name)] for name in station.layers):
        _, spread, axes = np.linalg.svd(p - p.mean(axis=0), full_matrices=False)
        if len(spread) < 3 or spread[2] < _FLAT * spread[0]:
            planes[k] = *p.mean(axis=0), *np.cross(axes[0], axes[1])
    return planes


def _pair_order(station: Station) -> tuple[Indices, Indices, Indices]:
    """Rank (M,) of each light in its layer, spread ones first; pairs (S, 2) of one layer; unseen (S,) before each."""
    orders = [_spread_order(station.p_dock[lights], lights) for lights in map(station.lights_of, station.layers)]
    done = [0] * len(orders)
    pairs, unseen = [], []

    def left(layer: int) -> int:
        """Most lights of a layer that can be named without a pair of those done."""
        return len(orders[layer]) - max(done[layer], 1) + 1

    while any(k < len(order) for order, k in zip(orders, done, strict=True)):
        layer = max((n for n in range(len(orders)) if done[n] < len(orders[n])), key=lambda n: (left(n), -n))
        most = max(map(left, range(len(orders))))
        k = done[layer]
        for earlier in range(k):
            pairs.append((orders[layer][earlier], orders[layer][k]))
            unseen.append(most)
        done[layer] += 1
    rank = np.empty(len(station), np.int64)
    for order in orders:
        rank[order] = np.arange(len(order))
    return rank, np.array(pairs, np.int64).reshape(-1, 2), np.array(unseen, np.int64)


def _spread_order(p: Array, lights: Indices) -> list[int]:
    """Lights in an order that keeps the next one far from those before it."""
    distance = np.linalg.norm(p[:, None] - p[None], axis=2)
    order = [int(distance.sum(axis=1).argmax())]
    while len(order) < len(p):
        nearest = distance[:, order].min(axis=1)
        nearest[order] = -1.0
        order.append(int(nearest.argmax()))
    return [int(lights[k]) for k in order]


def prior(attitude: Attitude | None, config: PriorConfig) -> Prior:
    """The attitude prior: the vehicle's own where it has one, else the configured one about head-on."""
    if attitude is not None:
        return Prior(np.ascontiguousarray(attitude.R_dock_cam), np.full(3, attitude.sigma_rad**-2), True)
    sigma = np.deg2rad([config.yaw_deg, config.pitch_deg, config.roll_deg])
    return Prior(_HEAD_ON, sigma**-2, False)


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """Detections as the kernels want them: N centres, their covariance and variance px^2, log likelihood ratios (N, L).

    `p_light` (N,) is 1 where nobody has said how likely it is a lamp.
    `log_density` 1/px^2 of spurious spots: geometric in number about `spurious`, a share of them where the detections
    stand.
    """

    uv: Array
    cov: Array
    var: Array
    like: Array
    p_light: Array
    log_density: float

    @property
    def lamps(self) -> int:
        """How many of the detections are rather lamps than not."""
        return int(np.count_nonzero(self.p_light >= _LAMP))


def spots(detections: Detections, plan: Plan, config: MatchConfig) -> Spots:
    """What the evidence needs to know of a frame's detections; centres without a covariance get the configured one.

    A spot that looks like no lamp may be more, or less, than one: its centre is worth a share of its radius.
    """
    uv, n = np.ascontiguousarray(detections.uv), len(detections)
    if detections.cov_px2 is None:
        cov = np.tile(np.eye(2) * config.noise_px**2, (n, 1, 1))
    else:
        cov = np.array(detections.cov_px2, np.float64, order="C")
    p_light, var, like = np.array(detections.p_light, np.float64), np.empty(n), np.empty((n, plan.n_layers))
    radius_px, p_rear = np.ascontiguousarray(detections.radius_px), np.ascontiguousarray(detections.p_rear)
    strange = config.unlikely_radii, _RADIUS_PX, _STRANGE
    span = kernel.weigh(uv, radius_px, p_rear, plan.is_rear, config.label_trust, strange, cov, p_light, like, var)
    whole, share = plan.lens[6] * plan.lens[7], config.clutter_near
    box = min(span + config.clutter_margin_px**2, whole) if n else whole
    density = (1.0 - share) / whole + share / box
    return Spots(uv, cov, var, like, p_light, math.log(density * config.spurious / (1.0 + config.spurious)))


def _log_clutter(found: Spots) -> Array:
    """Log price (N + 1,) of naming 0, 1, .. N detections instead of calling them clutter."""
    return np.concatenate([[0.0], np.cumsum(found.log_density + np.log(np.arange(len(found.uv), 0, -1)))])


def _parameters(plan: Plan, config: MatchConfig, tilt_var: float, roll_sigma: float, *, mixed: bool) -> Array:
    q = np.empty(10)
    q[kernel.LOG_VOLUME] = plan.log_volume
    q[kernel.DETECT], q[kernel.ABSENT] = config.detect, config.layer_absent
    q[kernel.GATE], q[kernel.NEAR_M], q[kernel.FAR_M] = config.gate, config.near_m, config.far_m
    q[kernel.PAIR_GATE] = config.pair_gate
    q[kernel.ROLL_GATE] = min(config.roll_gate * roll_sigma, math.pi)
    q[kernel.BEND] = (config.bend * tilt_var) ** 2
    q[kernel.STEADY] = config.steady if mixed else 0.0
    return q


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """One frame's spots and what is expected of them, as the kernels want them."""

    scene: Scene
    plan: Plan
    config: MatchConfig

    def mirrored(self) -> Scene:
        """The frame with the lights as the water's surface shows them."""
        return self.scene._replace(p=self.scene.p * _MIRROR, axis=self.scene.axis * _MIRROR)


def _question(plan: Plan, found: Spots, camera: Camera, expected: Prior, config: MatchConfig) -> _Question:
    offset = (found.uv - plan.lens[3:5]) * (0.5 * plan.sigma_focal)
    var = found.var + (offset**2).sum(axis=1)
    tilt_var, roll_sigma = float(1.0 / expected.info[:2].min()), float(expected.info[2] ** -0.5)
    q = _parameters(plan, config, tilt_var, roll_sigma, mixed=not expected.measured)
    by_u: Indices = np.argsort(found.uv[:, 0])
    steady = expected.info * config.steadier**2
    if roll_sigma > _OPEN_ROLL:
        steady[2] = expected.info[2]
    scene = Scene(
        plan.lens,
        plan.p_dock,
        plan.layer,
        plan.axis,
        plan.survey_m2,
        plan.rank,
        found.uv,
        by_u,
        camera.unproject(found.uv),
        var,
        float(var.max(initial=0.0)),
        found.like,
        _log_clutter(found),
        expected.R_dock_cam,
        expected.info,
        steady,
        q,
    )
    return _Question(scene, plan, config)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """K hypotheses, best first: the detection `names` (K, M) each light is given, log evidence, and poses.

    `whole` says whether the search came to its end.
    """

    names: Indices
    scores: Array
    Rs: Array
    ts: Array
    whole: bool


def _search(ask: _Question, scene: Scene, floor: int, *leasts: int, best: float = _NONE) -> _Found:
    """Hypotheses that name at least `floor` lights, by searches that want ever fewer of one layer.

    A later search runs only where the one before left doubt and the spots are few. `best` is a log evidence to measure
    up to.
    """
    plan, k, count = ask.plan, ask.config.hypotheses, 0
    listed = Listed(np.empty((k, len(scene.p)), np.int64), np.empty(k), np.empty((k, 3, 3)), np.empty((k, 3)))
    budget = np.array([ask.config.max_pairs])
    for least in leasts:
        bounds = np.array([least, floor, floor, floor - 1 if floor > least else 0])
        goal = Goal(bounds, budget, np.array([max(best, listed.scores[:count].max(initial=_NONE))]))
        count = search(scene, plan.pairs, plan.unseen, goal, count, listed)
        sure = count > 0 and listed.scores[:count].max() > ask.config.sure
        if sure or len(ask.scene.uv) > ask.config.max_detections_three:
            break
    order = np.argsort(-listed.scores[:count], kind="stable")
    names, scores, Rs, ts = listed
    return _Found(names[order], scores[order], Rs[order], ts[order], bool(budget[0] >= 0))


@dataclass(frozen=True, slots=True, eq=False)
class _Polished:
    """A naming (M,) that no relabelling betters; log evidence `without` each name, and `against` it."""

    name: Indices
    R: Array
    t: Array
    score: float
    without: Array
    against: Array


def _polish(ask: _Question, name: Indices, R: Array, t: Array, score: float) -> _Polished:
    """Follow the best relabelling as long as it is better."""
    m = len(name)
    for _ in range(_MAX_RELABELLINGS):
        without, against = np.empty(m), np.empty(m)
        better, taken = _no_naming(m), light_of(name, len(ask.scene.uv))
        best = rivals(Naming(name, R, t), taken, ask.scene, without, against, better)
        if best <= score:
            break
        name, R, t, score = *better, best
    return _Polished(name, R, t, score, without, against)


def _no_naming(m: int) -> Naming:
    """Room for a hypothesis of `m` lights."""
    return Naming(np.empty(m, np.int64), np.empty((3, 3)), np.empty(3))


def acquire(found: Spots, plan: Plan, camera: Camera, expected: Prior, config: MatchConfig) -> Acquisition:
    """The most probable naming of one frame's detections, and what it must be held against.

    Of many detections those that look least like lamps stay out.
    """
    likely = _likeliest(found, max(config.least_detections, config.detections_per_light * len(plan.p_dock)))
    if likely is not None:
        part = replace(found, **{key: getattr(found, key)[likely] for key in ("uv", "cov", "var", "like", "p_light")})
        return _renamed(acquire(part, plan, camera, expected, config), likely)
    ask = _question(plan, found, camera, expected, config)
    listed = _search(ask, ask.scene, 3, 4, 3)
    if not listed.whole:
        return Acquisition((), (), 0.0, "too_many")
    if not len(listed.scores):
        return Acquisition((), (), 0.0, "too_few" if len(found.uv) < 3 else "ambiguous")
    top = _polish(ask, listed.names[0], listed.Rs[0], listed.ts[0], float(listed.scores[0]))
    others = [pose for pose in (_other_pose(ask, top, level=level) for level in (False, True)) if pose is not None]
    best = max([top.score, *(score for _, score in others)])  # they share most of their mass
    strays, area = _strays(top.name, found)
    crowding = _crowding(strays, area, plan, config)
    odds = _odds(top, best, listed, crowding)
    kept = _kept(top.name, odds, plan, config)
    conflicting = listed.scores[conflicts(kept, listed.names)]
    mirror = _mirror_evidence(ask, top)
    against = float(np.logaddexp.reduce([-config.log_dock, mirror, *top.against[kept >= 0], *conflicting]))
    rest = [
        Hypothesis(name, _pose(R, t), float(s))
        for name, s, R, t in zip(listed.names, listed.scores, listed.Rs, listed.ts, strict=True)
        if s > best - config.keep and (name != kept).any()
    ]
    head = Hypothesis(kept, _pose(top.R, top.t), top.score)
    direct = float(np.logaddexp.reduce([_NONE, *listed.scores[(listed.names != top.name).any(axis=1)]]))
    reason = "mirror" if mirror > max(best - config.margin, direct) else "ambiguous"
    same = tuple(Hypothesis(kept, T_cam_dock, score) for T_cam_dock, score in others)
    margin = best - against
    rests = int((odds[kept >= 0] > config.margin_gathered).sum()) >= config.enough
    certainty = min(margin - (crowding if strays else 0.0), math.inf if rests else config.margin)
    return Acquisition((head, *rest), same, margin, reason, certainty)


def _other_pose(ask: _Question, top: _Polished, *, level: bool) -> tuple[Array, float] | None:
    """Another pose of the best names, if there is one nearly as good, and its log evidence."""
    other = _no_naming(len(top.name))
    score = other_pose(Naming(top.name, top.R, top.t), ask.scene, level, other)
    return (_pose(other.R, other.t), float(score)) if score > top.score - ask.config.keep else None


def _likeliest(found: Spots, most: int) -> Indices | None:
    """The detections (K,) that look most like lamps, `most` and those on a par; None where that leaves none out."""
    if len(found.uv) <= most:
        return None
    likely = np.flatnonzero(found.p_light >= np.partition(found.p_light, -most)[-most])
    return likely if len(likely) < len(found.uv) else None


def _renamed(found: Acquisition, detections: Indices) -> Acquisition:
    """An acquisition among some `detections` (K,), in the numbers of all."""

    def of_all(part: Hypothesis) -> Hypothesis:
        return replace(part, name=np.where(part.name >= 0, detections[part.name], -1))

    return replace(found, candidates=tuple(map(of_all, found.candidates)), others=tuple(map(of_all, found.others)))


def _odds(top: _Polished, best: float, listed: _Found, crowding: float) -> Array:
    """Log odds (M,) of each name against all that leave its detection out or name its light otherwise."""
    elsewhere = np.where(listed.names != top.name, listed.scores[:, None], _NONE)
    # most relabellings are in the list as well: counted once
    doubt = np.logaddexp(top.without + crowding, np.maximum(top.against, np.logaddexp.reduce(elsewhere)))
    return np.where(top.name >= 0, best - doubt, _NONE)


def _kept(name: Indices, odds: Array, plan: Plan, config: MatchConfig) -> Indices:
    """The naming (M,) without what is not beyond doubt: single names, and layers with too few of them.

    The names beyond doubt stay; where they are fewer than `enough`, the likeliest of the others fill up.
    """
    likeliest = np.sort(odds)[::-1]
    least = max(min(config.extra, float(likeliest[min(config.enough, len(odds)) - 1])), config.prune)
    kept = np.where(odds >= least, name, -1)
    count = np.bincount(plan.layer[kept >= 0], minlength=plan.n_layers)
    weak = (count < config.min_layer) & (count < count.max())
    return np.where(weak[plan.layer], -1, kept)


def _strays(name: Indices, found: Spots) -> tuple[int, float]:
    """How many unnamed spots stand around the named ones, and the area px^2 that they stand in."""
    used = found.uv[name[name >= 0]]
    low, high = used.min(axis=0), used.max(axis=0)
    low, high = low - 0.25 * (high - low), high + 0.25 * (high - low)
    inside = int(((found.uv >= low) & (found.uv <= high)).all(axis=1).sum()) - len(used)
    return inside, float((high - low).prod()) + 1.0


def _crowding(strays: int, area: float, plan: Plan, config: MatchConfig) -> float:
    """How much denser, as a logarithm >= 0, unnamed spots stand around the named ones than the evidence has it."""
    local = (strays + 0.5) / area
    return max(0.0, math.log(local * plan.lens[6] * plan.lens[7] / config.spurious))


def _mirror_evidence(ask: _Question, top: _Polished) -> float:
    """Log evidence, prior included, that the water's surface shows the array: only where it stands above the camera."""
    named = int((top.name >= 0).sum())
    listed = _search(ask, ask.mirrored(), named, min(named, 4), best=top.score)
    if not listed.whole:
        return top.score
    camera_y = -np.einsum("ki,ki->k", listed.Rs[:, :, 1], listed.ts)
    return float(np.logaddexp.reduce([_NONE, *listed.scores[camera_y < 0.0]])) + ask.config.log_mirror


def conflicts(name: Indices, others: Indices) -> np.ndarray:
    """Which of `others` (K, M) give a light of `name` (M,) another detection, or a detection another light: (K,)."""
    both = (name >= 0) & (others >= 0)
    light = np.full(max(int(name.max(initial=-1)), int(others.max(initial=-1))) + 2, -1)  # the last stands for none
    light[name[name >= 0]] = np.flatnonzero(name >= 0)
    theirs = light[others]
    claimed = (others >= 0) & (theirs >= 0) & (theirs != np.arange(len(name)))
    return np.asarray((both & (name != others) | claimed).any(axis=1))


def light_of(name: Indices, n: int) -> Indices:
    """Light of each of `n` detections from the detection of each light."""
    light = np.full(n, -1, np.int64)
    used = np.flatnonzero(name >= 0)
    light[name[used]] = used
    return light


def _pose(R: Array, t: Array) -> Array:
    T_cam_dock = np.eye(4)
    T_cam_dock[:3, :3], T_cam_dock[:3, 3] = R, t
    return T_cam_dock

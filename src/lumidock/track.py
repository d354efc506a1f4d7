"""The filter with history: pose, twist, sensor bias, calibration and survey errors in one state, fed with pixels.

A pose alone moves with every frame; calibration and light positions are only considered until lights of two layers
are seen together, because a plane cannot tell its own errors from the pose's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lumidock._kernels.tracking import association
from lumidock._kernels.tracking import track as kernel
from lumidock._kernels.tracking.track import Foreseen, State
from lumidock._kernels.tracking.update import Pixels, take_in
from lumidock.config import Config, TrackConfig
from lumidock.datatypes import Array, Attitude, Indices
from lumidock.match import Plan, Prior, Spots
from lumidock.station import Station

_WIDE_M, _WIDE_RAD = 100.0, 3.0  # what is not known of a pose before the first light
_SOLVE_STEPS, _TRACK_STEPS = 12, 4
_LEAVES, _SAME_SIGMA = 8, 0.1
_NEVER = -(2**62)
_FLATTENINGS = 12  # the flatter the view, the wider the tilt it leaves; then it stands
NO_PLANE = np.full(6, np.nan)
LAYER_LIGHTS, _PROOF_LIGHTS = 3, 4
_MARGIN_PX, _MAX_REACH_PX = 8.0, 200.0  # of the window around a light that is foreseen


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A pose with all that goes with it, at `t_ns`, since `began_ns`.

    `R`, `t` of T_cam_dock; `x` (n,) twist and slow states, `P` (n, n) their covariance with the pose's (order in
    `_kernels.track`). `joint`: slow states are being estimated. `log_weight`: log evidence since the track began.
    `proof`: frames since the last failed test in which four lights agreed; it is lost when none do for too long, since
    three fit many poses. `lights_ns`, `agreed_ns`, `layer_ns` (L,): when any light, when four and when each layer was
    seen last. Of the last frame: `name` (M,) the detection of each light, `count` how many of each layer have one,
    `apart` (M, 18) what leaving one out would do, `plane` (6,) the one that all lie on (NaN: none), `nis` the
    normalised innovation squared, `surprise` the same as a normal deviate, and `strain` the running mean of that over
    frames.
    """

    t_ns: int
    began_ns: int
    R: Array
    t: Array
    x: Array
    P: Array
    joint: bool
    log_weight: float
    proof: int
    lights_ns: int
    agreed_ns: int
    layer_ns: tuple[int, ...]
    name: Indices
    count: tuple[int, ...]
    apart: Array
    plane: Array
    nis: float
    surprise: float
    strain: float

    @property
    def T_cam_dock(self) -> Array:
        """Pose (4, 4) of the dock in `cam`."""
        T_cam_dock = np.eye(4)
        T_cam_dock[:3, :3], T_cam_dock[:3, 3] = self.R, self.t
        return T_cam_dock

    @property
    def n_used(self) -> int:
        """Lights in the last frame that agreed."""
        return sum(self.count)


def slow_states(station: Station, attitude: Attitude | None) -> tuple[Array, Array]:
    """Prior values (n,) and covariance (n, n) of everything but the pose; the pose and twist blocks are zero."""
    attitude_sigma = attitude.sigma_rad if attitude else 0.0
    m = len(station)
    n = kernel.LIGHTS + 3 * m
    P = np.zeros((n, n))
    P[kernel.BIAS : kernel.CALIBRATION, kernel.BIAS : kernel.CALIBRATION] = np.eye(3) * attitude_sigma**2
    P[15:18, 15:18] = np.diag([station.sigma_focal**2, station.sigma_center_px**2, station.sigma_center_px**2])
    together = station.layer[:, None] == station.layer[None, :]
    per_light = np.eye(m) * station.sigma_light_m**2 + together * station.sigma_layer_m**2
    P[kernel.LIGHTS :, kernel.LIGHTS :] = np.kron(per_light, np.eye(3))
    return np.zeros(n), P


def start(
    T_cam_dock: Array,
    name: Indices,
    t_ns: int,
    seen: Spots,
    plan: Plan,
    expected: Prior,
    slow: tuple[Array, Array],
    config: TrackConfig,
) -> Track | None:
    """A track from one frame's names and the pose that fits them; None where they do not hold together.

    `slow` is the prior of the other states, or what an earlier track had learned of them.
    """
    x, P = _open_pose(*slow, config)
    R0, t0 = T_cam_dock[:3, :3].copy(), T_cam_dock[:3, 3].copy()
    kernel.attitude_update(R0, t0, x, P, expected.R_dock_cam, 1.0 / expected.info, expected.measured)
    fresh = Track(
        t_ns,
        t_ns,
        R0,
        t0,
        x,
        P,
        False,
        0.0,
        0,
        t_ns,
        _NEVER,
        (_NEVER,) * plan.n_layers,
        name,
        plan.count(name),
        np.zeros((len(name), 18)),
        NO_PLANE,
        np.nan,
        0.0,
        0.0,
    )
    begun = update(fresh, name, seen, plan, config, at=T_cam_dock)
    for _ in range(_FLATTENINGS):
        if begun is None or not np.isfinite(begun.plane[0]):
            break
        before, begun = (
            begun,
            update(fresh, name, seen, plan, config, at=begun.T_cam_dock, turn_cov=begun.P[3:6, 3:6].copy()),
        )
        if begun is not None and np.trace(begun.P[3:6, 3:6]) < 1.02 * np.trace(before.P[3:6, 3:6]):
            break
    return begun


def _open_pose(x: Array, P: Array, config: TrackConfig) -> tuple[Array, Array]:
    """Copies of the slow states with a pose and a twist of which nothing is known."""
    x, P = x.copy(), P.copy()
    P[:3, :3], P[3:6, 3:6] = np.eye(3) * _WIDE_M**2, np.eye(3) * _WIDE_RAD**2
    P[6:9, 6:9], P[9:12, 9:12] = np.eye(3) * config.start_m_s**2, np.eye(3) * config.start_rad_s**2
    return x, P


def start_states(station: Station, attitude: Attitude | None, config: TrackConfig) -> tuple[Array, Array]:
    """Values (n,) and covariance (n, n) of all states before the first light."""
    return _open_pose(*slow_states(station, attitude), config)


def predict(track: Track, t_ns: int, config: TrackConfig) -> Track:
    """The track at a later time, its twist held but for white noise on it; what agreed too long ago proves nothing."""
    R, t, P = track.R.copy(), track.t.copy(), track.P.copy()
    kernel.predict(R, t, track.x[6:12], P, (t_ns - track.t_ns) * 1e-9, config.accel_m_s2**2, config.accel_rad_s2**2)
    lately = t_ns - track.agreed_ns <= config.max_gap_s * 1e9
    return replace(track, t_ns=t_ns, R=R, t=t, P=P, proof=track.proof if lately else 0)


def attend(track: Track, attitude: Attitude) -> Track:
    """The track with the vehicle's own attitude taken in."""
    R, t, x, P = track.R.copy(), track.t.copy(), track.x.copy(), track.P.copy()
    bias = slice(kernel.BIAS, kernel.CALIBRATION)
    if P[kernel.BIAS, kernel.BIAS] == 0.0:  # the track began without a sensor: its bias is as open as ever
        P[bias, bias] = np.eye(3) * attitude.sigma_rad**2
    var = np.full(3, attitude.sigma_rad**2)
    kernel.attitude_update(R, t, x, P, np.ascontiguousarray(attitude.R_dock_cam), var, True)
    return replace(track, R=R, t=t, x=x, P=P)


def foresee(foreseen: Foreseen) -> Array:
    """Where the lights of a predicted track will be seen: (n, 3) u, v and reach, four sigmas and a margin, px."""
    windows = np.empty((len(foreseen.shown), 3))
    return windows[: kernel.windows(foreseen, _MARGIN_PX, _MAX_REACH_PX, windows)]


def look(track: Track, plan: Plan) -> Foreseen:
    """Where the lights of a predicted track are expected."""
    m = len(plan.p_dock)
    foreseen = Foreseen(np.empty((m, 2)), np.empty((2 * m, 2 * m)), np.empty(m))
    kernel.look(plan.lens, State(track.R, track.t, track.x, track.P), plan.p_dock, plan.axis, foreseen)
    return foreseen


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """Names (M,) under a prediction, without the doubtful ones, and their log evidence over clutter."""

    name: Indices
    log_evidence: float


def associate(track: Track, seen: Spots, plan: Plan, config: Config, foreseen: Foreseen | None = None) -> Association:
    """Name the detections under the prediction, with backtracking and a missing branch; drop what stays in doubt.

    `foreseen`: what `look` said of this track, where it has been asked.

    A layer that was not in view enters with three lights or more, or not at all: where the tilt is open, a stray spot
    in the wide gate of a single light would set it.
    """
    foreseen = foreseen or look(track, plan)
    lately = [track.t_ns - t_ns <= config.track.max_gap_s * 1e9 for t_ns in track.layer_ns]
    if all(lately):
        return _search(foreseen, seen, plan, config)
    known = np.array(lately)[plan.layer]
    best = _search(foreseen._replace(shown=np.where(known, foreseen.shown, 0.0)), seen, plan, config)
    if foreseen.shown[~known].any():
        wider = _search(foreseen, seen, plan, config)
        new = np.bincount(plan.layer[(wider.name >= 0) & ~known], minlength=plan.n_layers)
        enters = (new == 0) | (new >= LAYER_LIGHTS)
        if new.any() and enters.all() and wider.log_evidence + config.track.log_appear > best.log_evidence:
            return wider
    return best


def _search(foreseen: Foreseen, seen: Spots, plan: Plan, config: Config) -> Association:
    """The best naming, without names that another nearly as good does not have; none where they are too many."""
    m = len(foreseen.shown)
    names, costs = np.empty((_LEAVES, m), np.int64), np.empty(_LEAVES)
    how = config.track
    terms = association.Terms(seen.log_density, config.match.detect, how.gate, how.reach, how.max_nodes)
    found = association.associate(foreseen, plan.layer, seen.uv, seen.var, seen.like, terms, names, costs)
    if found < 0:
        return Association(np.full(m, -1, np.int64), -np.inf)
    name, worth = names[0], -costs[:found]
    if found > 1:
        others = np.where(names[:found] != name, worth[:, None], -np.inf)
        doubt = np.logaddexp.reduce(others, axis=0)
        name = np.where(worth[0] - doubt < config.match.prune, -1, name)
    return Association(name, float(worth[0]))


def update(
    track: Track,
    name: Indices,
    seen: Spots,
    plan: Plan,
    config: TrackConfig,
    *,
    at: Array | None = None,
    turn_cov: Array | None = None,
    log_evidence: float = 0.0,
) -> Track | None:
    """The track with the named pixels taken in, linearised first at the pose `at`; None where that fails.

    `log_evidence` of the names goes to its weight.

    A single plane is linearised as flat as `turn_cov` (3, 3), by default the track's own, lets it be. From the first
    frame on that names `joint_lights` lights of two layers, calibration and light positions move too.
    """
    count = plan.count(name)
    joint = track.joint or _is_joint(count, config)
    R0, t0, x, P = track.R, track.t, track.x.copy(), track.P.copy()
    R, t = (track.R.copy(), track.t.copy()) if at is None else (at[:3, :3].copy(), at[:3, 3].copy())
    apart, plane = np.zeros((len(name), 18)), _plane(count, plan, joint=track.joint)
    nis = take_in(
        plan.lens,
        plan.p_dock,
        R0,
        t0,
        State(R, t, x, P),
        Pixels(name, seen.uv, seen.cov),
        len(P) if joint else kernel.CALIBRATION,
        _TRACK_STEPS if at is None else _SOLVE_STEPS,
        NO_PLANE if at is not None and turn_cov is None else plane,
        P[3:6, 3:6].copy() if turn_cov is None else turn_cov,
        at is None,
        apart,
    )
    if not math.isfinite(nis):
        return None
    used, t_ns = sum(count), track.t_ns
    before = zip(count, track.layer_ns, strict=True)
    layer_ns = tuple(t_ns if c >= LAYER_LIGHTS or (c > 0 and was > _NEVER) else was for c, was in before)
    # a pose of which nothing was known takes up six of the pixels' degrees of freedom
    dof = 2 * used - (0 if at is None else 6)
    surprise = _deviate(nis, dof) if dof > 0 else 0.0
    agreed_ns = track.t_ns if used >= _PROOF_LIGHTS else track.agreed_ns
    proof = track.proof + int(agreed_ns == track.t_ns)
    return Track(
        track.t_ns,
        track.began_ns,
        R,
        t,
        x,
        P,
        joint,
        track.log_weight + log_evidence,
        proof,
        track.t_ns,
        agreed_ns,
        layer_ns,
        name,
        count,
        apart,
        plane,
        nis,
        surprise,
        config.deviate_memory * track.strain + math.sqrt(1.0 - config.deviate_memory**2) * surprise,
    )


def _deviate(square: float, dof: int) -> float:
    """A chi-square value as a standard normal deviate. Source: E. Wilson, M. Hilferty, 1931."""
    spread = 2.0 / (9.0 * dof)
    return float(((square / dof) ** (1.0 / 3.0) - 1.0 + spread) / math.sqrt(spread))


def _plane(count: tuple[int, ...], plan: Plan, *, joint: bool) -> Array:
    """A point and the normal (6,) of the plane of all lights named, `count` by layer; NaN where no slant is asked for.

    It is none with two layers in view, and with four lights or more of a track that has seen two.
    """
    most = max(count)
    alone = 0 < most == sum(count) and not (joint and most >= _PROOF_LIGHTS)
    return plan.planes[count.index(most)] if alone else NO_PLANE


def is_joint(name: Indices, plan: Plan, config: TrackConfig) -> bool:
    """Whether at least two layers show enough lights."""
    return _is_joint(plan.count(name), config)


def _is_joint(count: tuple[int, ...], config: TrackConfig) -> bool:
    return sum(c >= config.joint_lights for c in count) >= 2


def learned(track: Track) -> tuple[Array, Array]:
    """What a track knows of its slow states, for a new start: their values (n,) and covariance (n, n), no pose."""
    x, P = track.x.copy(), track.P.copy()
    x[: kernel.BIAS] = 0.0
    P[: kernel.BIAS] = 0.0
    P[:, : kernel.BIAS] = 0.0
    return x, P


def same(a: Track, b: Track) -> bool:
    """Whether two beliefs are one: the same names, and poses a fraction of a sigma apart."""
    if (a.name != b.name).any():
        return False
    apart = np.concatenate([a.R.T @ (b.t - a.t), 0.5 * _vee(a.R.T @ b.R)])
    sigma = np.sqrt(np.diagonal(b.P)[:6])
    return bool((np.abs(apart) < _SAME_SIGMA * sigma + 1e-9).all())


def _vee(D: Array) -> Array:
    """Twice the axis times the sine of a rotation's angle (3,)."""
    return np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])

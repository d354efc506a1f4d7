"""The filter with history: pose, twist, sensor bias, calibration and survey errors in one state, fed with pixels.

A pose alone moves with every frame; calibration and light positions are only considered until lights of two layers
are seen together, because a plane cannot tell its own errors from the pose's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lumidock._kernels.measurements import Measurements
from lumidock._kernels.tracking import association
from lumidock._kernels.tracking import bank as bank_kernel
from lumidock._kernels.tracking import track as kernel
from lumidock._kernels.tracking import update as update_kernel
from lumidock._kernels.tracking.bank import Bank, BankRules
from lumidock._kernels.tracking.track import FilterState, PredictedMeasurements
from lumidock._kernels.tracking.update import Assigned, UpdateRules
from lumidock.config import Config, TrackConfig
from lumidock.datatypes import Array, Attitude, Indices
from lumidock.light_counts import CHECKED_LIGHTS, LAYER_LIGHTS, MAX_SUBSETS
from lumidock.match import Hypothesis
from lumidock.model import AttitudePrior, StationModel
from lumidock.station import Station

_WIDE_M, _WIDE_RAD = 100.0, 3.0  # 1 sigma of a pose before the first light: no station and no turn is larger
_SOLVE_STEPS, _TRACK_STEPS = 12, 4  # Gauss-Newton steps at most: from a first guess; from a prediction
_MAX_ASSOCIATIONS = 8  # of one frame and prediction that are compared
_SAME_SIGMA = 0.1  # poses nearer than this are one
_NEVER = -(2**62)  # ns
_MAX_FLATTENINGS, _FLATTENED = 12, 1.02  # the flatter the view, the wider the tilt it leaves, until it grows no more
_WINDOW_MARGIN_PX, _MAX_REACH_PX = 8.0, 200.0  # of a search window: room for the blob; no larger than a full search
SENSORS = 4  # of the vehicle, to each of which one state of an aided track's bank is blind
NO_PLANE = np.full(6, np.nan)


class CalibrationStates(NamedTuple):
    """Values `x` (n,) and covariance `P` (n, n) of all states but pose and twist, whose rows are zero."""

    x: Array
    P: Array


@dataclass(frozen=True, slots=True, eq=False)
class LastSeen:
    """When, ns, any light was seen last, when four or more agreed, and when each layer (L,) was."""

    light_ns: int
    agreed_ns: int
    layer_ns: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What the last frame did to a track.

    `assignment` (M,): the detection of each light or -1; `count`: lights with one by layer. `plane` (6,): the
    one that all of them lie on, NaN where none. `nis`: normalised innovation squared; `deviate`: the same as a standard
    normal deviate.
    """

    assignment: Indices
    count: tuple[int, ...]
    plane: Array
    nis: float
    deviate: float

    @property
    def n_used(self) -> int:
        """How many lights have a detection."""
        return sum(self.count)

    @classmethod
    def nothing(cls, model: StationModel) -> FrameResult:
        """A frame in which no light has a detection."""
        m = len(model)
        nobody = np.full(m, -1, np.int64)
        return cls(nobody, (0,) * model.n_layers, NO_PLANE, math.nan, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One hypothesis of the pose, followed over frames: its filter at `t_ns`, since `began_ns`.

    `state`: pose, other states and their covariance (order in `_kernels.track`). `bank`: for each light that was used
    a state that never saw it. `estimates_calibration`: lights of two
    layers have been seen together. `log_weight`: log evidence since the track began. `agreeing_frames`: frames since
    the last failed test in which four lights agreed; none when they did so too long ago, since three fit many poses.
    `mean_deviate`: exponential mean of the innovation deviates, scaled to unit variance.
    """

    t_ns: int
    began_ns: int
    state: FilterState
    bank: Bank
    seen: LastSeen
    last: FrameResult
    estimates_calibration: bool = False
    log_weight: float = 0.0
    agreeing_frames: int = 0
    mean_deviate: float = 0.0

    @property
    def T_cam_dock(self) -> Array:
        """Pose (4, 4) of the dock in `cam`."""
        T_cam_dock = np.eye(4)
        T_cam_dock[:3, :3], T_cam_dock[:3, 3] = self.state.R, self.state.t
        return T_cam_dock


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """The detection of each light or -1, `assignment` (M,), without what is in doubt; its log evidence over clutter."""

    assignment: Indices
    log_evidence: float


def calibration_prior(station: Station, attitude: Attitude | None) -> CalibrationStates:
    """What station and camera files say of survey and calibration, and the attitude of its sensor's bias."""
    attitude_sigma = attitude.sigma_rad if attitude else 0.0
    m = len(station)
    n = kernel.LIGHTS + 3 * m
    P = np.zeros((n, n))
    bias, camera = slice(kernel.BIAS, kernel.CALIBRATION), slice(kernel.CALIBRATION, kernel.LIGHTS)
    P[bias, bias] = np.eye(3) * attitude_sigma**2
    P[camera, camera] = np.diag([station.sigma_focal**2, station.sigma_center_px**2, station.sigma_center_px**2])
    together = station.layer[:, None] == station.layer[None, :]
    per_light = np.eye(m) * station.sigma_light_m**2 + together * station.sigma_layer_m**2
    P[kernel.LIGHTS :, kernel.LIGHTS :] = np.kron(per_light, np.eye(3))
    return CalibrationStates(np.zeros(n), P)


def learned_calibration(track: Track) -> CalibrationStates:
    """What a track knows of survey and calibration, for a new start."""
    x, P = track.state.x.copy(), track.state.P.copy()
    x[: kernel.BIAS] = 0.0
    P[: kernel.BIAS] = 0.0
    P[:, : kernel.BIAS] = 0.0
    return CalibrationStates(x, P)


def track_bytes(n_lights: int) -> int:
    """Memory of one hypothesis of a station with so many lights: the covariances of its filter and of its bank."""
    n = kernel.LIGHTS + 3 * n_lights
    return 8 * n * n * (1 + min(n_lights, MAX_SUBSETS))


def open_bank(model: StationModel, states: int = 0, sensors: int = 0) -> Bank:
    """A bank in which no subset has begun, of so many `states`, by default as many as the station needs.

    Behind the subsets that are blind to lights it has one for each of some `sensors`.
    """
    m = len(model)
    S, n = int(model.group.max()) + 1 + sensors, states or kernel.LIGHTS + 3 * m
    none, nobody = np.full(S, -1, np.int64), np.zeros(m, np.int64)
    return Bank(
        np.zeros((S, n)),
        np.empty((S, n, n)),
        begun=np.zeros(S, np.int64),
        plane=none,
        used=nobody,
        seen=nobody,
        proven=nobody,
    )


def empty_like(bank: Bank) -> Bank:
    """Room for the states of the same bank, and its flags."""
    offset, P, *flags = bank
    return Bank(np.empty_like(offset), np.empty_like(P), *(values.copy() for values in flags))


def _open_bank_of(state: FilterState, model: StationModel) -> Bank:
    """An open bank of as many states as the filter has; error states of sensors are those beyond the station's."""
    n = len(state.x)
    return open_bank(model, n, SENSORS if n > kernel.LIGHTS + 3 * len(model) else 0)


def _copied(bank: Bank) -> Bank:
    """The same bank in arrays of its own; what has not begun takes no time."""
    copied, begun = empty_like(bank), bank.begun == 1
    copied.offset[begun] = bank.offset[begun]
    for s in np.flatnonzero(begun):
        copied.P[s] = bank.P[s]
    return copied


def open_states(calibration: CalibrationStates, config: TrackConfig) -> tuple[Array, Array]:
    """Values (n,) and covariance (n, n) of all states before the first light: of pose and twist nothing is known."""
    x, P = calibration.x.copy(), calibration.P.copy()
    P[:3, :3], P[3:6, 3:6] = np.eye(3) * _WIDE_M**2, np.eye(3) * _WIDE_RAD**2
    P[6:9, 6:9], P[9:12, 9:12] = np.eye(3) * config.start_m_s**2, np.eye(3) * config.start_rad_s**2
    return x, P


def start(
    hypothesis: Hypothesis,
    frame: Measurements,
    model: StationModel,
    config: TrackConfig,
    *,
    t_ns: int,
    prior: AttitudePrior,
    calibration: CalibrationStates,
) -> Track | None:
    """A track from one frame's hypothesis; None where its lights do not hold together.

    Where all lights are of one plane, it is linearised ever flatter until the tilt's covariance grows no more.
    """
    x, P = open_states(calibration, config)
    state = FilterState(hypothesis.R.copy(), hypothesis.t.copy(), x, P)
    kernel.attitude_update(state, prior.R_dock_cam, 1.0 / prior.info, prior.measured)
    never = LastSeen(t_ns, _NEVER, (_NEVER,) * model.n_layers)
    nothing = FrameResult.nothing(model)
    fresh = Track(t_ns, t_ns, state, _open_bank_of(state, model), never, nothing, log_weight=hypothesis.log_evidence)
    first = _Start(hypothesis.R, hypothesis.t, None)
    begun = _update(fresh, hypothesis.assignment, frame, model, config, guess=first)
    for _ in range(_MAX_FLATTENINGS):
        if begun is None or math.isnan(begun.last.plane[0]):
            break
        turn_cov = begun.state.P[3:6, 3:6].copy()
        flatter = _Start(begun.state.R, begun.state.t, turn_cov)
        begun = _update(fresh, hypothesis.assignment, frame, model, config, guess=flatter)
        if begun is not None and np.trace(begun.state.P[3:6, 3:6]) < _FLATTENED * np.trace(turn_cov):
            break
    return None if begun is None else _bank_updated(fresh, begun, frame, model, config, starting=True)


def predict(
    track: Track,
    t_ns: int,
    config: TrackConfig,
    *,
    dock_noise: tuple[float, float] = (0.0, 0.0),
    max_gap_s: float | None = None,
) -> Track:
    """The track at a later time, in arrays of its own, its twist held but for white noise on it.

    `dock_noise`: (m/s)^2/s and (rad/s)^2/s that the dock's own motion adds. What agreed longer ago than `max_gap_s`,
    by default the configured gap, counts no more.
    """
    R, t, x, P = track.state
    state = FilterState(R.copy(), t.copy(), x.copy(), P.copy())
    bank, dt = _copied(track.bank), (t_ns - track.t_ns) * 1e-9
    q = config.accel_m_s2**2 + dock_noise[0], config.accel_rad_s2**2 + dock_noise[1]
    kernel.predict(state, dt, *q)
    bank_kernel.predict_bank(bank, state, dt, *q)
    lately = t_ns - track.seen.agreed_ns <= (config.max_gap_s if max_gap_s is None else max_gap_s) * 1e9
    return Track(
        t_ns=t_ns,
        began_ns=track.began_ns,
        state=state,
        bank=bank,
        seen=track.seen,
        last=track.last,
        estimates_calibration=track.estimates_calibration,
        log_weight=track.log_weight,
        agreeing_frames=track.agreeing_frames if lately else 0,
        mean_deviate=track.mean_deviate,
    )


def with_stamp_error(track: Track, stamp_s: float) -> Track:
    """A predicted track whose pose is wider by what the camera moves within the error of a frame's stamp.

    It is changed in place, as its arrays are its own.
    """
    state, bank = track.state, track.bank
    R_dock_cam, (v, w) = state.R.T, state.x[kernel.TWIST : kernel.BIAS].reshape(2, 3)
    turn = R_dock_cam @ w
    moved = stamp_s * np.concatenate([R_dock_cam @ v - np.cross(R_dock_cam @ state.t, turn), turn])
    spread = np.outer(moved, moved)
    state.P[:6, :6] += spread
    bank.P[bank.begun == 1, :6, :6] += spread
    return track


def update_attitude(track: Track, attitude: Attitude) -> Track:
    """The track updated by the vehicle's own attitude."""
    state = FilterState(*(values.copy() for values in track.state))
    bias = slice(kernel.BIAS, kernel.CALIBRATION)
    if state.P[kernel.BIAS, kernel.BIAS] == 0.0:  # the track began without a sensor: its bias is as open as ever
        state.P[bias, bias] = np.eye(3) * attitude.sigma_rad**2
    var = np.full(3, attitude.sigma_rad**2)
    R_dock_cam, bank = np.ascontiguousarray(attitude.R_dock_cam), _copied(track.bank)
    bank_kernel.attitude_bank(bank, state, R_dock_cam, var)
    kernel.attitude_update(state, R_dock_cam, var, True)
    bank_kernel.shift_bank(bank, track.state, state)
    return replace(track, state=state, bank=bank)


def predict_measurements(track: Track, model: StationModel) -> PredictedMeasurements:
    """Where the lights of a predicted track are expected, with the joint covariance of their pixels."""
    m = len(model)
    predicted = PredictedMeasurements(np.empty((m, 2)), np.empty((2 * m, 2 * m)), np.empty(m))
    kernel.predict_measurements(model.lights, track.state, predicted)
    return predicted


def search_windows(predicted: PredictedMeasurements) -> Array:
    """Where a detector has to look: (n, 3) u, v and reach, four sigmas and a margin, px."""
    windows = np.empty((len(predicted.shown), 3))
    return windows[: kernel.windows(predicted, _WINDOW_MARGIN_PX, _MAX_REACH_PX, windows)]


def associate(
    track: Track,
    frame: Measurements,
    model: StationModel,
    config: Config,
    predicted: PredictedMeasurements | None = None,
) -> Association:
    """Associate the detections under the prediction, with backtracking and missing lights; drop what stays in doubt.

    `predicted`: what `predict_measurements` said of this track, where it has been asked.

    A layer that was not in view lately, for `max_age_s`, enters with three lights or more, or not at all: where the
    tilt is open, clutter in the wide gate of a single light would set it.
    """
    predicted = predicted or predict_measurements(track, model)
    lately = [track.t_ns - t_ns <= config.integrity.max_age_s * 1e9 for t_ns in track.seen.layer_ns]
    if all(lately):
        return _associate(predicted, frame, model, config)
    known = np.array(lately)[model.layer]
    best = _associate(predicted._replace(shown=np.where(known, predicted.shown, 0.0)), frame, model, config)
    if predicted.shown[~known].any():
        wider = _associate(predicted, frame, model, config)
        new = np.bincount(model.layer[(wider.assignment >= 0) & ~known], minlength=model.n_layers)
        enters = (new == 0) | (new >= LAYER_LIGHTS)
        if new.any() and enters.all() and wider.log_evidence + config.track.log_appear > best.log_evidence:
            return wider
    return best


def _associate(
    predicted: PredictedMeasurements, frame: Measurements, model: StationModel, config: Config
) -> Association:
    """The best association, without what another nearly as good has not; log evidence -inf where they are too many."""
    m, how = len(model), config.track
    ranking = association.Ranking(np.empty((_MAX_ASSOCIATIONS, m), np.int64), np.empty(_MAX_ASSOCIATIONS))
    terms = association.Terms(config.match.detect, how.gate, how.reach, how.max_nodes)
    found = association.associate(predicted, model.layer, frame, terms, ranking)
    if found < 0:
        return Association(np.full(m, -1, np.int64), -np.inf)
    assignment, log_evidence = ranking.assignments[0], -ranking.costs[:found]
    if found > 1:
        others = np.where(ranking.assignments[:found] != assignment, log_evidence[:, None], -np.inf)
        doubt = np.logaddexp.reduce(others, axis=0)
        assignment = np.where(log_evidence[0] - doubt < config.match.prune, -1, assignment)
    return Association(assignment, float(log_evidence[0]))


class _Start(NamedTuple):
    """A first guess T_cam_dock `R`, `t` of a pose of which nothing is known.

    `turn_cov` (3, 3) rad^2: of the tilt by which a plane is flattened; None: it is taken as it is.
    """

    R: Array
    t: Array
    turn_cov: Array | None


def update(
    track: Track,
    assignment: Indices,
    frame: Measurements,
    model: StationModel,
    config: TrackConfig,
    *,
    log_evidence: float = 0.0,
) -> Track | None:
    """The track updated by the detections assigned, of this `log_evidence`; None where its pose does not settle.

    From the first frame on that shows `LAYER_LIGHTS` lights of two layers, calibration and light positions move too.
    """
    updated = _update(track, assignment, frame, model, config, log_evidence=log_evidence)
    return None if updated is None else _bank_updated(track, updated, frame, model, config, starting=False)


def _bank_updated(
    before: Track, after: Track, frame: Measurements, model: StationModel, config: TrackConfig, *, starting: bool
) -> Track:
    """The updated track with its bank updated too, which is still that of the track `before`."""
    seen = Assigned(after.last.assignment, frame.uv, frame.cov * config.memory)
    bank = empty_like(before.bank)
    rules = BankRules(
        group=model.group,
        layer=model.layer,
        planes=model.planes,
        estimated=len(after.state.x) if after.estimates_calibration else kernel.CALIBRATION,
        depth_known=after.estimates_calibration,
        starting=starting,
        turn_cov=after.state.P[3:6, 3:6].copy(),
        proven_m=config.proven_m,
    )
    bank_kernel.update_bank(model.lights, before.state, after.state, seen, rules, bank=before.bank, updated=bank)
    return replace(after, bank=bank)


def _update(
    track: Track,
    assignment: Indices,
    frame: Measurements,
    model: StationModel,
    config: TrackConfig,
    *,
    guess: _Start | None = None,
    log_evidence: float = 0.0,
) -> Track | None:
    """The filter's update, linearised first at a `guess`, or at the prediction where there is none."""
    count = model.count(assignment)
    both = track.estimates_calibration or sees_two_layers(count)
    R0, t0, x, P = track.state
    state = FilterState(R0.copy(), t0.copy(), x.copy(), P.copy())
    turn_cov, plane = P[3:6, 3:6].copy(), _plane(track, count, model)
    if guess:
        state = state._replace(R=guess.R.copy(), t=guess.t.copy())
        turn_cov = turn_cov if guess.turn_cov is None else guess.turn_cov
    rules = UpdateRules(
        estimated=len(P) if both else kernel.CALIBRATION,
        steps=_SOLVE_STEPS if guess else _TRACK_STEPS,
        tracking=guess is None,
        plane=NO_PLANE if guess and guess.turn_cov is None else plane,
        turn_cov=turn_cov,
    )
    seen = Assigned(assignment, frame.uv, frame.cov * config.memory)
    nis = update_kernel.update(model.lights, track.state, state, seen, rules)
    if not math.isfinite(nis):
        return None
    nis *= config.memory  # of the innovation against the covariance of one frame alone
    # a pose of which nothing was known takes up six of the pixels' degrees of freedom
    deviate = deviate_of(nis, 2 * sum(count) - (6 if guess else 0))
    result = FrameResult(assignment, count, plane, nis, deviate)
    seen_now = _seen(track, count)
    return replace(
        track,
        state=state,
        seen=seen_now,
        last=result,
        estimates_calibration=both,
        log_weight=track.log_weight + log_evidence,
        agreeing_frames=track.agreeing_frames + int(seen_now.agreed_ns == track.t_ns),
        mean_deviate=mean_of(track.mean_deviate, deviate, config.deviate_memory),
    )


def _seen(track: Track, count: tuple[int, ...]) -> LastSeen:
    """When lights were seen last, after a frame that shows so many of each layer: a layer enters with three or more."""
    t_ns, seen = track.t_ns, track.seen
    before = zip(count, seen.layer_ns, strict=True)
    layer_ns = tuple(t_ns if c >= LAYER_LIGHTS or (c > 0 and was > _NEVER) else was for c, was in before)
    return LastSeen(t_ns, t_ns if sum(count) >= CHECKED_LIGHTS else seen.agreed_ns, layer_ns)


def mean_of(before: float, deviate: float, memory: float) -> float:
    """The exponential mean of normal deviates, scaled so that its variance is one as well."""
    return memory * before + math.sqrt(1.0 - memory**2) * deviate


def deviate_of(square: float, dof: int) -> float:
    """A chi-square value as a standard normal deviate, 0 without freedom. Source: E. Wilson, M. Hilferty, 1931."""
    if dof <= 0:
        return 0.0
    spread = 2.0 / (9.0 * dof)
    return float(((square / dof) ** (1.0 / 3.0) - 1.0 + spread) / math.sqrt(spread))


def _plane(track: Track, count: tuple[int, ...], model: StationModel) -> Array:
    """A point and the normal (6,) of the plane of all lights assigned, `count` by layer; NaN where no slant is wanted.

    It is none with two layers in view, and with four lights or more of a track that has seen two.
    """
    most = max(count)
    alone = 0 < most == sum(count) and not (track.estimates_calibration and most >= CHECKED_LIGHTS)
    return model.planes[count.index(most)] if alone else NO_PLANE


def sees_two_layers(count: tuple[int, ...]) -> bool:
    """Whether at least two layers show enough lights, `count` by layer, to tell survey and calibration from pose."""
    return sum(c >= LAYER_LIGHTS for c in count) >= 2


def same(a: Track, b: Track) -> bool:
    """Whether two tracks are one: the same assignment, and poses a fraction of a sigma apart."""
    if (a.last.assignment != b.last.assignment).any():
        return False
    R = a.state.R
    apart = np.concatenate([R.T @ (b.state.t - a.state.t), 0.5 * _vee(R.T @ b.state.R)])
    return bool((np.abs(apart) < _SAME_SIGMA * np.sqrt(np.diagonal(b.state.P)[:6]) + 1e-9).all())


def _vee(D: Array) -> Array:
    """Twice the axis times the sine of a rotation's angle (3,)."""
    return np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])

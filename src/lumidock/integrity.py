"""May a pose be used: protection levels, alert limits, the two levels of trust, the docking stage; and the fix."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from lumidock._kernels.tracking.levels import Groups, SigmaFactors, protection_levels
from lumidock._kernels.tracking.track import TWIST
from lumidock.alert_limits import AlertLimits
from lumidock.config import IntegrityConfig
from lumidock.datatypes import (
    Alternative,
    Array,
    Contradiction,
    Detections,
    Excess,
    Fix,
    Guide,
    Match,
    Protection,
    Stage,
    Status,
    Velocity,
)
from lumidock.file_check import contradiction
from lumidock.geometry import se3_inverse
from lumidock.model import StationModel, light_of
from lumidock.state import Context, LocalizerState
from lumidock.track import Track
from lumidock.verify import contradict, is_proven

_ANY_BEARING_RAD = math.sqrt(2.0) * math.pi  # at the origin itself a bearing says nothing ...
_CLEAR, _STEEP_RAD = 2.0, 0.3  # ... which begins so many range levels away, or with such a bearing level
_COIN = 0.5  # a level that an error exceeds as often as not is none: no more of the risk is given to a fault
_IDENTITY = np.eye(4)  # copied: half as long as another
_OPEN = ("ambiguous", "unproven")  # reasons with which the poses that fit are given


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """A pose `T_dock_cam` (4, 4), its covariance (6, 6) in dock axes, its guide and all their protection levels."""

    T_dock_cam: Array
    covariance: Array
    protection: Protection
    guide: Guide


def bounds(tracks: Sequence[Track], model: StationModel, config: IntegrityConfig) -> Bounds:
    """Protection of the first hypothesis, wide enough to hold every other that is likelier than the risk.

    Without a fault the levels are factors on sigma; they also hold when any one light has been at fault at any time
    since the track began (`_kernels.tracking.bank`).
    """
    first = tracks[0]
    cov = np.empty((9, 9))
    pl = _levels(first, model, config, cov)
    for other in tracks[1:]:
        if first.log_weight - other.log_weight < -math.log(config.risk):
            apart = _apart(first, other)
            wider = apart + np.array(_levels(other, model, config, np.empty((9, 9))))
            pl = tuple(np.maximum(pl, wider).tolist())
    T_dock_cam, R_dock_cam, t = _IDENTITY.copy(), first.state.R.T, first.state.t
    T_dock_cam[:3, :3], T_dock_cam[:3, 3] = R_dock_cam, -(R_dock_cam @ t)
    x, y, z = t.tolist()
    reach = math.sqrt(x * x + y * y + z * z)
    lateral, axial, angle, bearing, distance = pl
    linear = bearing < _STEEP_RAD and min(math.hypot(x, z), math.hypot(y, z)) > _CLEAR * distance
    return Bounds(
        T_dock_cam,
        cov[:6, :6],
        Protection(lateral, axial, angle),
        Guide(
            math.atan2(x, z),
            math.atan2(y, z),
            reach,
            bearing if linear else max(bearing, _ANY_BEARING_RAD),
            distance,
        ),
    )


def _levels(track: Track, model: StationModel, config: IntegrityConfig, cov: Array) -> tuple[float, ...]:
    """Lateral m, axial m, angle rad, bearing rad, range m of one hypothesis; fills `cov` (9, 9)."""
    begun = track.bank.begun == 1
    if not math.isfinite(float(track.bank.P[begun, :6, :6].sum() + track.bank.offset[begun].sum())):
        return (math.inf,) * 5  # a light that cannot be left out leaves no level
    factors = fault_factors(int(track.bank.used.sum()), config)
    return protection_levels(track.state, track.last.plane, track.bank, Groups(model.group, model.planes), factors, cov)


def fault_factors(n_lights: int, config: IntegrityConfig) -> SigmaFactors:
    """The factors with `n_lights` lights that may be at fault, one at a time: they share the risk."""

    def of(prior: float) -> Array:
        return sigma_factors(min(config.risk / (prior * max(n_lights, 1)), _COIN))

    sensor = sigma_factors(min(config.risk / config.fault_sensor, _COIN))
    return SigmaFactors(sigma_factors(config.risk), of(config.fault), of(config.fault_proven), sensor)


@cache
def sigma_factors(risk: float) -> Array:
    """Sigmas (3,) that the length of a normal vector of 1, 2 and 3 dimensions exceeds with probability `risk`."""
    return np.array([_sigma_factor(risk, dimensions) for dimensions in (1, 2, 3)])


def _sigma_factor(risk: float, dimensions: int) -> float:
    low, high = 0.0, 40.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _tail(middle, dimensions) > risk else (low, middle)
    return high


def _tail(k: float, dimensions: int) -> float:
    """Probability that a standard normal vector is longer than `k`."""
    if dimensions == 2:
        return math.exp(-0.5 * k * k)
    one = math.erfc(k / math.sqrt(2.0))
    return one if dimensions == 1 else one + math.sqrt(2.0 / math.pi) * k * math.exp(-0.5 * k * k)


def _apart(a: Track, b: Track) -> Array:
    """How far two poses lie apart in what the levels bound: lateral, axial, angle, bearing, range (5,)."""
    (Ra, ta, *_), (Rb, tb, *_) = a.state, b.state
    at = -(Ra.T @ ta) + Rb.T @ tb
    turn = math.acos(min(max(0.5 * (float(np.trace(Ra.T @ Rb)) - 1.0), -1.0), 1.0))
    between = [math.atan2(ta[k], ta[2]) - math.atan2(tb[k], tb[2]) for k in (0, 1)]
    bearing = math.hypot(*(math.remainder(angle, 2.0 * math.pi) for angle in between))
    distance = abs(float(np.linalg.norm(ta) - np.linalg.norm(tb)))
    return np.array([math.hypot(at[0], at[1]), abs(at[2]), turn, bearing, distance])


def pose_holds(bound: Bounds, limits: AlertLimits) -> bool:
    """Whether the full pose's protection levels are inside the alert limits of the dock."""
    return excess(bound, limits) is None


def excess(bound: Bounds, limits: AlertLimits) -> Excess | None:
    """The protection level of the pose that is over its alert limit by the largest factor; None where none is."""
    pl = bound.protection
    lateral_m, axial_m, angle_rad = limits.of_pose(float(bound.T_dock_cam[2, 3]), pl.axial_m)
    levels = (
        Excess("lateral", pl.lateral_m, lateral_m),
        Excess("axial", pl.axial_m, axial_m),
        Excess("angle", pl.angle_rad, angle_rad),
    )
    over = [one for one in levels if not one.level < one.limit]  # a level that is no number is over it
    return max(over, key=lambda one: one.factor, default=None)


def guide_holds(bound: Bounds, limits: AlertLimits) -> bool:
    """Whether bearing and range may be used: by their own limits from afar, near the dock where the pose may be."""
    guide = bound.guide
    near_end_m = guide.range_m - guide.pl_range_m
    if not limits.applies_to_guide(guide.bearing_x_rad, near_end_m):
        return pose_holds(bound, limits)
    bearing_rad, range_m = limits.of_guide(near_end_m)
    return guide.pl_bearing_rad < bearing_rad and guide.pl_range_m < range_m


def stage(track: Track, model: StationModel) -> Stage | None:
    """Docking stage by the layers that the pose rests on (paper section 2.2); None without a light."""
    rear = sum(c for c, is_rear in zip(track.last.count, model.is_rear, strict=True) if is_rear)
    front = track.last.n_used - rear
    if front and rear:
        return "transition"
    return "rear" if rear else "front" if front else None


def assess(
    state: LocalizerState, detections: Detections, status: Status, context: Context
) -> tuple[Fix, LocalizerState]:
    """The fix of the likeliest hypothesis as far as it can be trusted, and the state with its docking stage."""
    first, config = state.first, context.config.integrity
    if status == "coasting" and (reason := _why_no_coasting(state, detections.t_ns, context)):
        return no_fix(state, detections, status, reason), state
    bound = bounds(state.hypotheses, context.model, config)
    against = _contradiction(state, context)
    doubt, limits = _doubt(state, context), context.station.alert_limits
    if against and doubt in ("", "unproven"):  # a wrong file is why an association does not reach its evidence
        doubt = against.file
    too_wide, used = excess(bound, limits), first.last.n_used
    valid = not doubt and too_wide is None
    reason = "" if valid else doubt or _why_wide(state, config)
    now = stage(first, context.model) or state.stage
    contradicted = against is not None
    if (now, contradicted) != (state.stage, state.contradicted):
        state = replace(state, stage=now, contradicted=contradicted)
    fix = Fix(
        detections.frame,
        detections.t_ns,
        status,
        state.stage,
        n_seen=len(detections),
        n_used=used,
        T_dock_cam=bound.T_dock_cam if valid else None,
        reason=reason,
        match=Match(detections, light_of(first.last.assignment, len(detections))),
        covariance=bound.covariance if valid else None,
        protection=bound.protection if valid else None,
        guide=bound.guide if not doubt and guide_holds(bound, limits) else None,
        nis=first.last.nis / (2 * used) if status == "tracking" else math.nan,
        alternatives=alternatives(state.hypotheses) if reason in _OPEN else (),
        excess=too_wide if reason == "protection" else None,
        contradiction=against if against and doubt == against.file else None,
        aiding=state.aiding.uses(detections.t_ns),
    )
    return (replace(fix, velocity=velocity(first)) if fix.valid or fix.guide else fix), state


def velocity(track: Track) -> Velocity:
    """The motion of `cam` as a track has it."""
    x, both = track.state.x, slice(TWIST, TWIST + 6)
    return Velocity(x[TWIST : TWIST + 3].copy(), x[TWIST + 3 : TWIST + 6].copy(), track.state.P[both, both].copy())


def _why_wide(state: LocalizerState, config: IntegrityConfig) -> str:
    """The word for levels that are too wide: another association that has to be held possible, or few lights."""
    first, *others = state.hypotheses
    rivals = [one for one in others if first.log_weight - one.log_weight < -math.log(config.risk)]
    return "ambiguous" if any(contradict(first.last.assignment, r.last.assignment) for r in rivals) else "protection"


def _contradiction(state: LocalizerState, context: Context) -> Contradiction | None:
    """What the track's lights, or those of a layer that it cannot explain, say against the files."""
    return state.contradiction or contradiction(
        state.first, context.station, context.parameters, state.distortion, before=state.contradicted
    )


def alternatives(tracks: Sequence[Track]) -> tuple[Alternative, ...]:
    """The poses that hypotheses hold possible, with their probabilities among them."""
    if not tracks:
        return ()
    share = np.exp(np.array([one.log_weight for one in tracks]) - tracks[0].log_weight)
    share /= share.sum()
    return tuple(Alternative(float(p), se3_inverse(one.T_cam_dock)) for p, one in zip(share, tracks, strict=True))


def _doubt(state: LocalizerState, context: Context) -> str:
    """The word for a track that no level makes valid: another fits too, or it is not proven."""
    first, config = state.first, context.config.integrity
    if not is_proven(first, state.margin, config):
        rivals = state.hypotheses[1:]
        return "ambiguous" if any(contradict(first.last.assignment, r.last.assignment) for r in rivals) else "unproven"
    if state.twin:
        return "ambiguous"
    # in the dark nothing can take over a track that the vehicle's own sensors carry; the first lights are checked
    dark = state.dark_frames if state.aiding.carries(first.t_ns) else 0
    if state.thin_frames - dark >= config.thin_frames:
        return "unproven"
    return ""


def _why_no_coasting(state: LocalizerState, t_ns: int, context: Context) -> str:
    """The word for a track that no light fits in this frame and that may not be used without one, or nothing.

    A failed test ends trust at once, a dark frame when the last light is too old: later where the vehicle's own sensors
    carry the track.
    """
    first, config = state.first, context.config
    if first.agreeing_frames == 0:  # nothing has agreed since a test failed, or for too long
        return "residual"
    most_s = config.aiding.max_age_s if state.aiding.carries(t_ns) else config.integrity.max_age_s
    return "stale" if (t_ns - first.seen.light_ns) * 1e-9 > most_s else ""


def no_fix(state: LocalizerState, detections: Detections, status: Status, reason: str) -> Fix:
    """The answer to a frame that gives no pose, and why."""
    spurious = Match(detections, np.full(len(detections), -1, np.int64))
    frame, t_ns, seen = detections.frame, detections.t_ns, len(detections)
    poses = alternatives(state.hypotheses) if reason in _OPEN else ()
    return Fix(
        frame,
        t_ns,
        status,
        state.stage,
        n_seen=seen,
        reason=reason,
        match=spurious,
        alternatives=poses,
        aiding=state.aiding.uses(t_ns),
    )

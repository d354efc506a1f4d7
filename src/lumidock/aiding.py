"""The vehicle's own sensors in the track: gyro, DVL, depth, tilt and attitude, at their own rates and times.

Values wait in a buffer until the next frame, and are then applied in the order of their times: the values of one sensor
within `group_s` as their mean, at its time, to which every hypothesis is predicted. A mean needs no integration of its
own, loses nothing while the motion between two frames is smooth, and costs one update for each sensor and frame. What
does not average out over values is a state of the filter, beside its others, from the first value on: bias of the gyro,
scale and mount of the DVL, the depth of the dock, and the direction that is upward in `dock`.

For each sensor the bank holds one more state, which does not see it, until the lights have proven the sensor. So the
protection levels hold while it may be lying, as they do for a light; and a sensor that lies is declined.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lumidock import track
from lumidock._kernels.tracking.aiding import SensorRows, SensorRules, update_by_sensor
from lumidock._kernels.tracking.bank import Bank
from lumidock._kernels.tracking.track import CALIBRATION, LIGHTS, FilterState
from lumidock.config import AidingConfig, Config
from lumidock.datatypes import AidingMeasurement, Array, Attitude, SensorKind, SensorUse
from lumidock.geometry import rotation_from_quat_xyzw
from lumidock.model import StationModel
from lumidock.sensor_models import (
    ERRORS,
    Before,
    Group,
    SensorModel,
    declared,
    dock_noise,
    model_of,
    only,
    walk,
)
from lumidock.track import Track

PROVABLE: tuple[SensorKind, ...] = ("gyro", "velocity", "depth", "tilt")  # each with a state of the bank blind to it
MAX_BUFFER = 2000  # values that may wait for a frame: 4 s of all sensors at 100 Hz
_LATE_S = 0.5  # a value that comes so long after the frame that it belongs before says nothing of now
_AHEAD_S = 5.0  # one that is stamped so long after the next frame is of another clock
_SILENT_S = 0.5  # without a value; a DVL has two in this time
_PROVEN_SHARE = 0.3  # of a declared variance, at most, that is left when the lights have measured an error
_PROVEN_TEST = 9.0  # chi-square, 1 dof, 0.3 %, that the error then has to pass
_PROVEN_S = 3.0  # of agreement, in which noise and delay show too
_MATTERS = 0.01  # share of the largest variance, below which one does nothing
_CONTRADICTION = 24.0  # chi-square, 1 dof, 1e-6
_TOLD_SHARE = 0.02  # least share of a declared variance that measurements removed; below it nothing is told
_DRIFT_MEMORY, _MAX_DRIFT = 0.97, 4.9  # 30 groups: 6 s of a DVL; two-sided normal, 1e-6
_DOUBTED = 2.5  # two-sided normal, 1 %: a sensor that may have begun to lie carries nothing in the dark
_JUMPS = 5.0  # groups that are refused, more or less in a row, before a sensor is declined ...
_FORGIVEN = 0.25  # ... and how much of that a good one takes back
_NEVER = -(2**62)  # ns


@dataclass(frozen=True, slots=True)
class SensorTest:
    """How a sensor has stood up to the lights so far.

    `last_ns` of its last group, which had the mean `value`; `agreed_s`: how long it has agreed; `jumps`: groups refused
    of late; `mean_deviate`: exponential mean of their NIS as normal deviates; `drift`: that of the innovations
    themselves, number by number, which is zero for a sensor without a bias. Both are scaled to unit variance.
    """

    kind: SensorKind
    last_ns: int = _NEVER
    value: tuple[float, ...] = ()
    agreed_s: float = 0.0
    jumps: float = 0.0
    mean_deviate: float = 0.0
    drift: tuple[float, ...] = ()
    proven: bool = False
    declined: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class AidingState:
    """Values that wait for the next frame, in the order of their arrival, and the tests of the sensors so far."""

    buffer: tuple[AidingMeasurement, ...] = ()
    tests: tuple[SensorTest, ...] = ()

    def with_value(self, value: AidingMeasurement) -> AidingState:
        """The state with one more value that waits; of too many the oldest are dropped."""
        return replace(self, buffer=(*self.buffer[-MAX_BUFFER + 1 :], value))

    def test_of(self, kind: SensorKind) -> SensorTest:
        """The test of a sensor; a new one where it has given no value."""
        return next((test for test in self.tests if test.kind == kind), SensorTest(kind))

    def with_test(self, test: SensorTest) -> AidingState:
        """The state with another test of one sensor."""
        tests = {one.kind: one for one in self.tests} | {test.kind: test}
        return replace(self, tests=tuple(tests.values()))

    def uses(self, t_ns: int) -> tuple[SensorUse, ...]:
        """What is done with each sensor that has given values, for a fix at `t_ns`."""
        return tuple(_use(test, t_ns) for test in self.tests)

    def carries(self, t_ns: int) -> bool:
        """Whether gyro and velocity are proven, heard and not in doubt: then a track lasts longer without light."""
        return all(
            test.proven and not test.declined and not _is_silent(test, t_ns) and _most(test.drift) < _DOUBTED
            for test in (self.test_of("gyro"), self.test_of("velocity"))
        )


NO_AIDING = AidingState()


def _most(numbers: tuple[float, ...]) -> float:
    """The largest size among some numbers."""
    return max(map(abs, numbers), default=0.0)


def _is_silent(test: SensorTest, t_ns: int) -> bool:
    return (t_ns - test.last_ns) * 1e-9 > _SILENT_S


def _use(test: SensorTest, t_ns: int) -> SensorUse:
    if test.declined:
        return SensorUse(test.kind, "declined", test.declined)
    if _is_silent(test, t_ns):
        return SensorUse(test.kind, "silent")
    return SensorUse(test.kind, "used" if test.proven else "proving")


class Advanced(NamedTuple):
    """Tracks at the time of a frame, the aiding's next state, and whether a sensor lied that they had been given."""

    tracks: tuple[Track, ...]
    aiding: AidingState
    deceived: bool


def advance(
    tracks: Sequence[Track], aiding: AidingState, t_ns: int, model: StationModel, config: Config, *, confirmed: bool
) -> Advanced:
    """Predict tracks to `t_ns`, by way of all values that were measured until then.

    The first track, where it is `confirmed`, decides whether a value is believed, and whether its sensor is.
    """
    due, later = _due(aiding.buffer, t_ns, config.aiding)
    aiding, tracks = replace(aiding, buffer=later), tuple(tracks)
    for group in groups(due, config.aiding):
        test = aiding.test_of(group.kind)
        if test.declined or (tracks and (tracks[0].t_ns - group.t_ns) * 1e-9 > _LATE_S):
            continue
        tracks = tuple(predict(one, max(group.t_ns, one.t_ns), aiding, config) for one in tracks)
        tracks, test = _applied(tracks, group, test, model, config, confirmed=confirmed)
        aiding = aiding.with_test(test)
        if test.declined and tracks:
            return Advanced((), aiding, deceived=True)
    return Advanced(tuple(predict(one, t_ns, aiding, config) for one in tracks), aiding, deceived=False)


def predict(one: Track, t_ns: int, aiding: AidingState, config: Config) -> Track:
    """A track at a later time; aided it may last longer without a light, and a dock that moves adds to its twist."""
    return track.predict(
        one,
        t_ns,
        config.track,
        dock_noise=dock_noise(config.aiding.dock_motion),
        max_gap_s=max_gap_s(aiding, t_ns, config),
    )


def max_gap_s(aiding: AidingState, t_ns: int, config: Config) -> float:
    """How long a track lasts without a light, s."""
    gap_s = config.track.max_gap_s
    return gap_s + config.aiding.max_age_s if aiding.carries(t_ns) else gap_s


def _delay_s(kind: SensorKind, config: AidingConfig) -> float:
    """By how much the stamps of a sensor are late, s."""
    delay_s: dict[SensorKind, float] = {
        "gyro": config.gyro.delay_s,
        "velocity": config.velocity.delay_s,
        "depth": config.depth.delay_s,
        "tilt": config.tilt.delay_s,
    }
    return delay_s.get(kind, 0.0)


def _due(
    buffer: Sequence[AidingMeasurement], t_ns: int, config: AidingConfig
) -> tuple[list[AidingMeasurement], tuple[AidingMeasurement, ...]]:
    """Values that were measured until `t_ns`, delays removed and in the order of time, and those that wait on."""
    shifted = [(one.t_ns - round(_delay_s(one.kind, config) * 1e9), one) for one in buffer]
    due = sorted(((t, k) for k, (t, _) in enumerate(shifted) if t <= t_ns))
    later = tuple(one for t, one in shifted if t_ns < t <= t_ns + _AHEAD_S * 1e9)
    return [replace(buffer[k], t_ns=t) for t, k in due], later


def groups(values: Sequence[AidingMeasurement], config: AidingConfig) -> Iterator[Group]:
    """Means of the values (in the order of time) of each sensor within `group_s`, in the order of time."""
    found: list[list[AidingMeasurement]] = []
    last: dict[SensorKind, list[AidingMeasurement]] = {}
    for one in values:
        group = last.get(one.kind)
        if group is None or one.kind == "attitude" or one.t_ns - group[0].t_ns > config.group_s * 1e9:
            last[one.kind] = group = []
            found.append(group)
        group.append(one)
    yield from sorted((_mean(group) for group in found), key=lambda group: group.t_ns)


def _mean(values: Sequence[AidingMeasurement]) -> Group:
    n, first = len(values), values[0]
    if n == 1:
        return Group(first.kind, first.t_ns, first.value, first.sigma)
    t_ns = first.t_ns + sum(one.t_ns - first.t_ns for one in values) // n
    mean = np.mean([one.value for one in values], axis=0)
    sigma = math.sqrt(sum(one.sigma**2 for one in values)) / n
    return Group(first.kind, t_ns, tuple(mean.tolist()), sigma)


def _applied(
    tracks: tuple[Track, ...], group: Group, test: SensorTest, model: StationModel, config: Config, *, confirmed: bool
) -> tuple[tuple[Track, ...], SensorTest]:
    """Tracks at the time of a group, updated by it unless the first refuses it, and the sensor's test after it."""
    if group.kind == "attitude":
        x, y, z, w = group.value
        sensor = Attitude(rotation_from_quat_xyzw(np.array([x, y, z, w])), group.sigma)
        passed = replace(test, last_ns=group.t_ns, proven=True)
        return tuple(track.update_attitude(one, sensor) for one in tracks), passed
    heard = replace(test, last_ns=group.t_ns, value=group.value)
    if not tracks:
        return tracks, replace(heard, agreed_s=0.0)
    tracks = tuple(_ready(one, group, test, model, config) for one in tracks)
    models = [model_of(one, group, Before(test.last_ns, test.value), config.aiding) for one in tracks]
    judged = _judged(tracks[0], models[0], test, heard, config) if confirmed else heard
    if judged.declined or judged.jumps > test.jumps:
        return tracks, judged
    for one, against in zip(tracks, models, strict=True):
        _update(one, against.rows, group.kind, model)
    return tracks, _proven(tracks[0], models[0], test, judged, config) if confirmed else judged


def _ready(one: Track, group: Group, test: SensorTest, model: StationModel, config: Config) -> Track:
    """A track in arrays of its own, with the states that a sensor needs, as far as these have wandered meanwhile."""
    if len(one.state.x) == LIGHTS + 3 * len(model):
        one = widened(one, model, config.aiding)
    subset = _subset(group.kind, one.bank)
    if test.proven:
        one.bank.begun[subset] = 0
    elif one.bank.begun[subset] == 0:
        one.bank.begun[subset], one.bank.plane[subset] = 1, -1
        one.bank.offset[subset], one.bank.P[subset] = 0.0, one.state.P
    dt = min(max((group.t_ns - test.last_ns) * 1e-9, 0.0), 10.0) if test.last_ns > _NEVER else 0.0
    at = np.arange(len(one.state.x) - ERRORS, len(one.state.x))
    more, begun = walk(group.kind, config.aiding) * dt, np.flatnonzero(one.bank.begun)
    one.state.P[at, at] += more
    one.bank.P[begun[:, None], at, at] += more
    return one


def _subset(kind: SensorKind, bank: Bank) -> int:
    """The state of a bank that is blind to a sensor."""
    return len(bank.begun) - track.SENSORS + PROVABLE.index(kind)


def widened(one: Track, model: StationModel, config: AidingConfig) -> Track:
    """A track with error states behind its own, as the settings declare them, and a bank with a state per sensor."""
    state, bank, n = one.state, one.bank, len(one.state.x)
    prior = declared(config)
    x, P = np.concatenate([state.x, np.zeros(ERRORS)]), np.zeros((n + ERRORS, n + ERRORS))
    P[:n, :n], P[range(n, n + ERRORS), range(n, n + ERRORS)] = state.P, prior
    wide = track.open_bank(model, n + ERRORS, track.SENSORS)
    begun = np.flatnonzero(bank.begun)
    wide.offset[begun, :n] = bank.offset[begun]
    wide.P[begun] = P
    wide.P[begun, :n, :n] = bank.P[begun]
    s = len(bank.begun)
    wide.begun[:s], wide.plane[:s] = bank.begun, bank.plane
    wide = wide._replace(used=bank.used, seen=bank.seen, proven=bank.proven)
    return replace(one, state=FilterState(state.R, state.t, x, P), bank=wide)


def _update(one: Track, rows: SensorRows, kind: SensorKind, model: StationModel) -> None:
    """Update a track that is in arrays of its own, in place; the calibration only where it is estimated."""
    lights = LIGHTS + 3 * len(model)
    rules = SensorRules(_subset(kind, one.bank), lights if one.estimates_calibration else CALIBRATION, lights)
    update_by_sensor(one.state, one.bank, rows, rules)


def _judged(one: Track, against: SensorModel, test: SensorTest, heard: SensorTest, config: Config) -> SensorTest:
    """The test after an innovation: too large a one is refused, too many refused and the sensor is declined."""
    columns, H, residual, var = against.rows
    S = H @ one.state.P[np.ix_(columns, columns)] @ H.T + np.diag(var)
    nis = float(residual @ np.linalg.solve(S, residual))
    deviate, how = track.deviate_of(nis, against.dof), config.track
    if deviate > how.max_deviate:
        jumps = test.jumps + 1.0
        return replace(heard, jumps=jumps, agreed_s=0.0, declined="jumps" if jumps >= _JUMPS else "")
    mean = track.mean_of(test.mean_deviate, deviate, how.deviate_memory)
    drift = test.drift or (0.0,) * len(residual)
    if one.last.n_used:  # without lights a track agrees with its sensors
        normal = (residual / np.sqrt(np.diagonal(S))).tolist()
        drift = tuple(track.mean_of(old, new, _DRIFT_MEMORY) for old, new in zip(drift, normal, strict=True))
    lying = "noise" if mean > how.max_mean_deviate else "bias" if _most(drift) > _MAX_DRIFT else ""
    return replace(heard, jumps=max(test.jumps - _FORGIVEN, 0.0), mean_deviate=mean, drift=drift, declined=lying)


def _proven(one: Track, against: SensorModel, before: SensorTest, test: SensorTest, config: Config) -> SensorTest:
    """The test after an update: what the lights say of a sensor's errors, against what was declared of them.

    Each error's square over the variance that measurements have taken out of the declared one is chi-square of one
    degree of freedom while the declaration holds (a score test, as for the calibration states).
    """
    if one.last.n_used == 0 or one.agreeing_frames == 0:  # without lights nothing contradicts a sensor
        return test
    known = [_told(one, against.errors, part, config.aiding) for part in against.parts]
    tested = known if against.delay < 0 else [*known, _told(one, against.errors, only(against.delay), config.aiding)]
    if any(told.contradicts() for told in tested):
        return replace(test, declined="bias")
    since_s = (test.last_ns - before.last_ns) * 1e-9 if before.last_ns > _NEVER else 0.0
    agreed_s = test.agreed_s + min(max(since_s, 0.0), _SILENT_S)
    proven = agreed_s >= _PROVEN_S and all(told.proves() for told in known)
    return replace(test, agreed_s=agreed_s, proven=test.proven or proven)


class _Told(NamedTuple):
    """What the lights have told of a source of error in K numbers: declared variance, that left, estimate (K,)."""

    prior: Array
    left: Array
    value: Array

    def contradicts(self) -> bool:
        """Whether an estimate is further off than what was declared allows."""
        told = self.prior - self.left
        tells = told > _TOLD_SHARE * self.prior
        return bool((self.value[tells] ** 2 > _CONTRADICTION * told[tells]).any())

    def proves(self) -> bool:
        """Whether all errors are measured, and small, as far as they do anything."""
        counts, told = self.prior > _MATTERS * self.prior.max(), self.prior - self.left
        measured = self.left[counts] <= _PROVEN_SHARE * self.prior[counts]
        return bool((measured & (self.value[counts] ** 2 < _PROVEN_TEST * told[counts])).all())


def _told(one: Track, errors: Array, part: slice, config: AidingConfig) -> _Told:
    n, E = len(one.state.x) - ERRORS, errors[:, part]
    own = slice(n + part.start, n + part.stop)
    prior = np.einsum("ki,i,ki->k", E, declared(config)[part], E)
    return _Told(prior, np.einsum("ki,ij,kj->k", E, one.state.P[own, own], E), E @ one.state.x[own])

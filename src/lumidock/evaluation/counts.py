"""What is counted in one simulated run of a campaign, and how the counts of many runs are added up.

Counts and histograms hold integers, so that their sum does not depend on how the runs were spread over workers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from typing_extensions import Self

from lumidock.alert_limits import DEFAULT_ALERT_LIMITS, AlertLimits
from lumidock.datatypes import Array, Fix, Indices
from lumidock.evaluation.claims import GUIDE_ERRORS, POSE_ERRORS, GuideClaims, PoseClaims, nees
from lumidock.sim.detections import SimulatedFrame
from lumidock.sim.scenario import Scenario

_BINS_PER_DECADE, _LEAST = 100, 1e-6  # of the histograms: m, rad, frames or 1
_BINS = 10 * _BINS_PER_DECADE
_FULL, _SOME = 6, 4  # detected lights: with six a guide is expected, with four a fix is possible
_NEAR_TRUTH = 3.0  # sigmas of the noise within which a wrong detection stands where the missing light would be
_STALE_NS = 300_000_000  # a fix may be predicted so long after the last detected light, `max_age_s` of the settings


@dataclass(slots=True)
class Tally:
    """Counts by name; histograms on fixed logarithmic bins; the largest of each kind; NEES by stage [frames, sum]."""

    counts: Counter[str] = field(default_factory=Counter)
    histograms: dict[str, Counter[int]] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)
    nees: dict[str, list[float]] = field(default_factory=dict)

    def add(self, **counts: int | np.integer[Any]) -> None:
        """Add to the counts."""
        for name, count in counts.items():
            self.counts[name] += int(count)

    def spread(self, name: str, values: Array) -> None:
        """Put `values` (N,), none negative, into a histogram; what is not finite stays out."""
        values = values[np.isfinite(values)]
        bins = np.floor(np.log10(np.maximum(values, _LEAST) / _LEAST) * _BINS_PER_DECADE).astype(int)
        numbers, counts = np.unique(np.minimum(bins, _BINS - 1), return_counts=True)
        histogram = self.histograms.setdefault(name, Counter())
        histogram.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        self.note(name, values)

    def note(self, name: str, values: Array) -> None:
        """Keep the largest of `values` (N,), none negative."""
        self.largest[name] = float(values.max(initial=self.largest.get(name, 0.0)))

    def quantile(self, name: str, share: float) -> float | None:
        """Value below which `share` of a histogram lies, to one part in a hundred; None for an empty one."""
        histogram = self.histograms.get(name, Counter())
        wanted, seen = share * histogram.total(), 0
        for number in sorted(histogram):
            seen += histogram[number]
            if seen >= wanted:
                return min(float(_LEAST * 10.0 ** ((number + 0.5) / _BINS_PER_DECADE)), self.largest[name])
        return None

    def merge(self, other: Tally) -> None:
        """Add the counts of another tally; the order matters to the last digit of NEES alone."""
        self.counts.update(other.counts)
        for name, histogram in other.histograms.items():
            self.histograms.setdefault(name, Counter()).update(histogram)
        for name, value in other.largest.items():
            self.largest[name] = max(self.largest.get(name, 0.0), value)
        for stage, (frames, total) in other.nees.items():
            before = self.nees.get(stage, [0, 0.0])
            self.nees[stage] = [before[0] + frames, before[1] + total]

    def as_dict(self) -> dict[str, Any]:
        """For a shard's file."""
        return {
            "counts": dict(self.counts),
            "histograms": {name: dict(sorted(bins.items())) for name, bins in self.histograms.items()},
            "largest": self.largest,
            "nees": self.nees,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """What `as_dict` gave, through JSON or not."""
        histograms = {
            name: Counter({int(number): count for number, count in bins.items()})
            for name, bins in content["histograms"].items()
        }
        return cls(Counter(content["counts"]), histograms, dict(content["largest"]), dict(content["nees"]))


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRun:
    """One seed of a scenario: N frames, their fixes and the dock's alert limits.

    `eligible` (N,) says in which frames the Cramer-Rao bound allows a valid fix; None where it was not computed.
    """

    scenario: Scenario
    seed: int
    frames: Sequence[SimulatedFrame]
    fixes: Sequence[Fix]
    alert_limits: AlertLimits = DEFAULT_ALERT_LIMITS
    eligible: np.ndarray | None = None

    def flags(self, name: str) -> np.ndarray:
        """Of each frame (N,): whether its fix is `accepted`, `valid` or has a `guide`."""
        tests: dict[str, Callable[[Fix], bool]] = {
            "accepted": lambda fix: fix.status != "none",
            "valid": lambda fix: fix.valid,
            "guide": lambda fix: fix.guide is not None,
        }
        return np.fromiter(map(tests[name], self.fixes), bool, len(self.fixes))


def tally_run(run: SimulatedRun) -> Tally:
    """Everything that is counted in one run."""
    tally = Tally()
    tally.add(runs=1, frames=len(run.frames))
    frame, true, assigned = _assignments(run)
    lights = np.bincount(frame[true >= 0], minlength=len(run.frames))
    _count_identities(tally, run, frame, true, assigned)
    _count_fixes(tally, run, lights)
    _judge_poses(tally, run)
    _judge_guides(tally, run)
    _count_gaps(tally, run)
    _count_sequences(tally, run)
    _count_blind(tally, run, lights)
    return tally


def _assignments(run: SimulatedRun) -> tuple[Indices, Indices, Indices]:
    """All S detections of a run: frame, true light, and the light it was assigned to, (S,) each; -1 for none."""
    counts = [len(frame.light) for frame in run.frames]
    nothing = np.full(max(counts, default=0), -1, np.int64)
    assigned = [
        nothing[:count] if fix.match is None else fix.match.light for fix, count in zip(run.fixes, counts, strict=True)
    ]
    frame = np.repeat(np.arange(len(counts)), counts)
    return frame, np.concatenate([frame.light for frame in run.frames]), np.concatenate(assigned)


def _count_identities(tally: Tally, run: SimulatedRun, frame: Indices, true: Indices, assigned: Indices) -> None:
    """Identified detections, and wrong ones: `true` is exact here, so another lamp or no lamp made the detection.

    A wrong one is a harmful coincidence where the light that it was assigned to would have been seen.
    """
    wrong = (assigned >= 0) & (assigned != true)
    uv = np.concatenate([one.detections.uv for one in run.frames])[wrong]
    truth = np.array([one.uv for one in run.frames])[frame[wrong], assigned[wrong]]
    near = np.linalg.norm(uv - truth, axis=1) <= _NEAR_TRUTH * run.scenario.detections.noise_px
    tally.add(
        identified=(assigned >= 0).sum(),
        wrong_other_light=(true[wrong] >= 0).sum(),
        wrong_coincident=near.sum(),
        wrong_else=(~near).sum(),
        frames_with_wrong=len(np.unique(frame[wrong])),
    )


def _count_fixes(tally: Tally, run: SimulatedRun, lights: Indices) -> None:
    """Frames, and those with a fix, by the number `lights` (N,) of detected lights; and the reasons for no fix."""
    usable = {word: run.flags(word) for word in ("accepted", "valid", "guide")}
    groups = {
        "": np.ones(len(lights), bool),
        "_few": lights < _SOME,
        "_some": (lights >= _SOME) & (lights < _FULL),
        "_full": lights >= _FULL,
    }
    if run.eligible is not None:
        groups["_eligible"] = run.eligible
    for suffix, group in groups.items():
        if suffix:
            tally.add(**{f"frames{suffix}": group.sum()})
        tally.add(**{f"{word}{suffix}": (flags & group).sum() for word, flags in usable.items()})
    reasons = Counter(fix.reason for fix in run.fixes if fix.reason)
    tally.counts.update({f"reason {word}": count for word, count in reasons.items()})


def _judge_poses(tally: Tally, run: SimulatedRun) -> None:
    """Errors of the valid poses, their protection levels, and how many errors are over the alert limits."""
    chosen = [pair for pair in zip(run.frames, run.fixes, strict=True) if pair[1].valid]
    if not run.scenario.shows_dock:
        tally.add(hazardous_valid=len(chosen))  # no pose can be right where the dock is not in view
        return
    if not chosen:
        return
    claims = pose_claims(chosen, run.alert_limits)
    errors, levels = claims.sizes(), claims.levels
    over = errors > claims.limits()
    tally.add(hazardous_valid=over.any(axis=1).sum())
    tally.add(**{f"hazardous_{name}": which.sum() for name, which in zip(POSE_ERRORS, over.T, strict=True)})
    _count_over(tally, run, int((errors > levels).any(axis=1).sum()))
    for name, error, level in zip(POSE_ERRORS, errors.T, levels.T, strict=True):
        _spread_error(tally, name, error, level)
    _count_nees(tally, run, [frame.sequence for frame, _ in chosen], claims)


def _count_over(tally: Tally, run: SimulatedRun, over: int) -> None:
    """So many valid poses are over one of their levels; runs with any, and those that say what is wrong."""
    said = any(fix.reason == run.scenario.says for fix in run.fixes)
    tally.add(over_level=over, runs_over_level=over > 0, runs_over_said=over > 0 and said)


def _spread_error(tally: Tally, name: str, error: Array, level: Array) -> None:
    """Histograms of an error (N,) and its protection level (N,), and how often the one is over the other."""
    tally.spread(f"error_{name}", error)
    tally.spread(f"level_{name}", level)
    tally.add(**{f"levels_{name}": np.isfinite(level).sum(), f"over_level_{name}": (error > level).sum()})


def pose_claims(pairs: Sequence[tuple[SimulatedFrame, Fix]], limits: AlertLimits) -> PoseClaims:
    """Errors of valid fixes against the truth, and the uncertainty that they state."""
    T = np.array([fix.T_dock_cam for _, fix in pairs])
    T_true = np.array([frame.T_dock_cam for frame, _ in pairs])
    unknown = np.full((6, 6), np.nan)
    levels = [
        (np.nan,) * 3 if (p := fix.protection) is None else (p.lateral_m, p.axial_m, p.angle_rad) for _, fix in pairs
    ]
    w = rotation_vectors(T[:, :3, :3] @ T_true[:, :3, :3].transpose(0, 2, 1))
    return PoseClaims(
        T[:, 2, 3],
        np.concatenate([T[:, :3, 3] - T_true[:, :3, 3], w], axis=1),
        np.array(levels),
        np.array([unknown if fix.covariance is None else fix.covariance for _, fix in pairs]),
        [fix.stage for _, fix in pairs],
        limits,
    )


def rotation_vectors(R: Array) -> Array:
    """Rotation vectors (N, 3) rad of rotation matrices `R` (N, 3, 3); at half a turn only the length is sure."""
    v = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine, cosine = np.linalg.norm(v, axis=1), 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)
    angle, tiny = np.arctan2(sine, cosine), sine < 1e-9
    w = v * (angle / np.where(tiny, 1.0, sine))[:, None]
    w[tiny] = np.where(cosine[tiny, None] > 0.0, v[tiny], [np.pi, 0.0, 0.0])
    return np.asarray(w)


def _count_nees(tally: Tally, run: SimulatedRun, sequence: list[int], claims: PoseClaims) -> None:
    """NEES of one frame of each sequence and stage: the errors of neighbouring frames are correlated.

    The seed decides which frame, since always taking the first would be a biased sample.
    """
    given = np.asarray(np.isfinite(claims.covariance).all(axis=(1, 2)))
    keys = np.random.default_rng([run.seed, 100]).random(len(given))
    chosen: dict[tuple[int, str], int] = {}
    for i in np.flatnonzero(given).tolist():
        place = (sequence[i], claims.stage[i])
        if place not in chosen or keys[i] > keys[chosen[place]]:
            chosen[place] = i
    picked = list(chosen.values())
    squares = nees(claims.errors[picked], claims.covariance[picked])
    for (_, stage), square in zip(chosen, squares.tolist(), strict=True):
        if np.isfinite(square):
            before = tally.nees.get(stage, [0, 0.0])
            tally.nees[stage] = [before[0] + 1, before[1] + square]
        else:
            tally.add(improper_covariances=1)


def _judge_guides(tally: Tally, run: SimulatedRun) -> None:
    """Errors of the guides, their protection levels, and how many errors are over the alert limits."""
    chosen = [pair for pair in zip(run.frames, run.fixes, strict=True) if pair[1].guide is not None]
    if not run.scenario.shows_dock:
        tally.add(hazardous_guide=len(chosen))
        return
    if not chosen:
        return
    claims = guide_claims(chosen, run.alert_limits)
    errors = claims.sizes()
    over = errors > run.alert_limits.of_guides(claims.true)
    tally.add(hazardous_guide=over.any(axis=1).sum())
    tally.add(**{f"hazardous_{name}": which.sum() for name, which in zip(GUIDE_ERRORS, over.T, strict=True)})
    for name, error, level in zip(GUIDE_ERRORS, errors.T, claims.levels.T, strict=True):
        _spread_error(tally, name, error, level)


def guide_claims(pairs: Sequence[tuple[SimulatedFrame, Fix]], limits: AlertLimits) -> GuideClaims:
    """The guides of fixes, and the true ones."""
    guides = [fix.guide for _, fix in pairs if fix.guide is not None]
    T = np.array([frame.T_dock_cam for frame, _ in pairs])
    x, y, z = -np.einsum("nji,nj->in", T[:, :3, :3], T[:, :3, 3])
    return GuideClaims(
        np.array([(g.bearing_x_rad, g.bearing_y_rad, g.range_m) for g in guides]),
        np.stack([np.arctan2(x, z), np.arctan2(y, z), np.sqrt(x * x + y * y + z * z)], axis=1),
        np.array([(g.pl_bearing_rad, g.pl_range_m) for g in guides]),
        limits,
    )


def _count_gaps(tally: Tally, run: SimulatedRun) -> None:
    """The longest time between two usable frames in a row of the same sequence."""
    t_ns = np.array([frame.detections.t_ns for frame in run.frames])
    sequence = np.array([frame.sequence for frame in run.frames])
    for word in ("valid", "guide"):
        usable = run.flags(word)
        same = np.diff(sequence[usable]) == 0
        gaps = np.diff(t_ns[usable])[same]
        tally.add(**{f"gaps_over_half_second_{word}": (gaps > 500_000_000).sum()})
        if len(gaps):
            tally.note(f"gap_s_{word}", gaps * 1e-9)


def _count_sequences(tally: Tally, run: SimulatedRun) -> None:
    """In how many sequences of a path of draws there was a fix by their k-th frame."""
    hold = run.scenario.path.hold
    if run.scenario.path.kind != "draws" or hold == 1:
        return
    tally.add(sequences=len(run.frames) // hold)
    for word in ("accepted", "valid", "guide"):
        by_now = np.logical_or.accumulate(run.flags(word).reshape(-1, hold), axis=1)
        tally.add(**{f"{word}_by_{k + 1}": by_now[:, k].sum() for k in range(hold)})


def _count_blind(tally: Tally, run: SimulatedRun, lights: Indices) -> None:
    """Fixes given more than 0.3 s after the last detected light, and how many frames of light bring a fix back."""
    t_ns = np.array([frame.detections.t_ns for frame in run.frames])
    begins = np.array([frame.step == 0 for frame in run.frames])
    last = np.maximum.accumulate(np.where(lights > 0, np.arange(len(lights)), -1))
    start = np.maximum.accumulate(np.where(begins, np.arange(len(lights)), 0))
    blind = lights == 0
    stale = blind & ((last < start) | (t_ns - t_ns[last] > _STALE_NS))
    tally.add(frames_blind=blind.sum(), frames_stale=stale.sum())
    tally.add(stale_valid=(run.flags("valid") & stale).sum(), stale_guide=(run.flags("guide") & stale).sum())
    if run.scenario.path.kind != "draws":
        _count_returns(tally, blind, run.flags("valid"), run.flags("guide"))


def _count_returns(tally: Tally, blind: np.ndarray, valid: np.ndarray, guide: np.ndarray) -> None:
    """Frames (1 is the first with a light) from the end of each time without light to the next fix."""
    change = np.diff(blind.astype(np.int8))
    first, again = np.flatnonzero(change == 1) + 1, np.flatnonzero(change == -1) + 1
    again = again[again > first[0]] if len(first) else again[:0]
    ends = np.append(first[1:], len(blind))[: len(again)]
    for before, a, b in zip(first[: len(again)] - 1, again, ends, strict=True):
        for word, flags in (("valid", valid), ("guide", guide)):
            if flags[before]:
                back = np.flatnonzero(flags[a:b])[:1] + 1.0
                tally.add(**{f"blinded_{word}": 1, f"never_back_{word}": not len(back)})
                tally.spread(f"frames_back_{word}", back)

"""A campaign: scenarios x seeds x methods through the light door, counted.

A shard is one scenario, one method and a block of seeds. Its counts land in a file of its own as soon as they are
there, so that a campaign that was cut short goes on where it was. What a table says does not depend on how many workers
there were: counts and histograms are of integers, and shards are added up in their order.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, Protocol, Self

import cv2
import numpy as np

from lumidock import trust
from lumidock.bound import Bound
from lumidock.camera import Camera, load_camera
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Fix, Indices
from lumidock.errors import InputError, LumidockError
from lumidock.sim.scenario import Scenario
from lumidock.sim.spots import SpotFrame, spot_frames
from lumidock.station import Station, load_station
from lumidock.trust import GUIDE_ERRORS, POSE_ERRORS, GuideClaims, PoseClaims
from lumidock.yamlfile import validate

METHODS = ("lumidock", "paper")
_SEEDS_PER_SHARD = 5
_MAX_POOLS = 4  # a worker that dies takes its pool with it; the shards that are left get so many in all
_BINS_PER_DECADE, _LEAST = 100, 1e-6  # of the histograms: m, rad, frames or 1
_BINS = 10 * _BINS_PER_DECADE
_FULL, _SOME = 6, 4  # detected lights: from six on guidance is owed, from four on a fix can be had
_NEAR_TRUTH = 3.0  # sigmas of the noise within which a wrong spot stands where its light would
_STALE_NS = 300_000_000  # without any light an answer is good for so long
_DEG = 180.0 / np.pi
Progress = Callable[[int, int | None], None]


class _LightDoor(Protocol):
    def process_detections(self, detections: Detections) -> Fix: ...

    def forget(self) -> None: ...


# What is counted


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
class Run:
    """One seed of a scenario: N frames and their fixes.

    `eligible` (N,) says in which frames a valid fix is owed; None where nobody has worked it out.
    """

    scenario: Scenario
    seed: int
    frames: Sequence[SpotFrame]
    fixes: Sequence[Fix]
    eligible: np.ndarray | None = None

    def flags(self, name: str) -> np.ndarray:
        """Of each frame (N,): whether its fix is `accepted`, `valid` or has a `guide`."""
        tests: dict[str, Callable[[Fix], bool]] = {
            "accepted": lambda fix: fix.status != "none",
            "valid": lambda fix: fix.valid,
            "guide": lambda fix: fix.guide is not None,
        }
        return np.fromiter(map(tests[name], self.fixes), bool, len(self.fixes))


def tally_run(run: Run) -> Tally:
    """Everything that is counted in one run."""
    tally = Tally()
    tally.add(runs=1, frames=len(run.frames))
    frame, true, named = _labels(run)
    lights = np.bincount(frame[true >= 0], minlength=len(run.frames))
    _count_labels(tally, run, frame, true, named)
    _count_answers(tally, run, lights)
    _judge_poses(tally, run)
    _judge_guides(tally, run)
    _count_gaps(tally, run)
    _count_sequences(tally, run)
    _count_blind(tally, run, lights)
    return tally


def _labels(run: Run) -> tuple[Indices, Indices, Indices]:
    """All spots of a run in a row: frame, true light and the light it was named after, (S,) each; -1 for none."""
    counts = [len(frame.light) for frame in run.frames]
    nothing = np.full(max(counts, default=0), -1, np.int64)
    named = [
        nothing[:count] if fix.match is None else fix.match.light for fix, count in zip(run.fixes, counts, strict=True)
    ]
    frame = np.repeat(np.arange(len(counts)), counts)
    return frame, np.concatenate([frame.light for frame in run.frames]), np.concatenate(named)


def _count_labels(tally: Tally, run: Run, frame: Indices, true: Indices, named: Indices) -> None:
    """Names given, and wrong ones; a wrong one is a harmful coincidence where its light would have been seen."""
    wrong = (named >= 0) & (named != true)
    uv = np.concatenate([one.detections.uv for one in run.frames])[wrong]
    truth = np.array([one.uv for one in run.frames])[frame[wrong], named[wrong]]
    near = np.linalg.norm(uv - truth, axis=1) <= _NEAR_TRUTH * run.scenario.spots.noise_px
    tally.add(
        named=(named >= 0).sum(),
        wrong_coincident=near.sum(),
        wrong_else=(~near).sum(),
        frames_with_wrong=len(np.unique(frame[wrong])),
    )


def _count_answers(tally: Tally, run: Run, lights: Indices) -> None:
    """Frames, and those with an answer, by the number `lights` (N,) of detected lights; and why there was none."""
    answers = {word: run.flags(word) for word in ("accepted", "valid", "guide")}
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
        tally.add(**{f"{word}{suffix}": (flags & group).sum() for word, flags in answers.items()})
    reasons = Counter(fix.reason for fix in run.fixes if fix.reason)
    tally.counts.update({f"reason {word}": count for word, count in reasons.items()})


def _judge_poses(tally: Tally, run: Run) -> None:
    """Errors of the valid poses, their protection levels, and which of them mislead."""
    chosen = [pair for pair in zip(run.frames, run.fixes, strict=True) if pair[1].valid]
    if not run.scenario.shows_dock:
        tally.add(hazardous_valid=len(chosen))  # no pose can be right of what is not in view
        return
    if not chosen:
        return
    claims = pose_claims(chosen)
    errors, levels = claims.sizes(), claims.levels
    over = errors > claims.limits()
    tally.add(hazardous_valid=over.any(axis=1).sum())
    tally.add(**{f"hazardous_{name}": which.sum() for name, which in zip(POSE_ERRORS, over.T, strict=True)})
    for name, error, level in zip(POSE_ERRORS, errors.T, levels.T, strict=True):
        _spread_error(tally, name, error, level)
    _count_nees(tally, run, [frame.sequence for frame, _ in chosen], claims)


def _spread_error(tally: Tally, name: str, error: Array, level: Array) -> None:
    """Histograms of an error (N,) and its protection level (N,), and how often the one is over the other."""
    tally.spread(f"error_{name}", error)
    tally.spread(f"level_{name}", level)
    tally.add(**{f"levels_{name}": np.isfinite(level).sum(), f"over_level_{name}": (error > level).sum()})


def pose_claims(pairs: Sequence[tuple[SpotFrame, Fix]]) -> PoseClaims:
    """What valid fixes say of themselves, and how far off they are."""
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
    )


def rotation_vectors(R: Array) -> Array:
    """Rotation vectors (N, 3) rad of rotation matrices `R` (N, 3, 3); at half a turn only the length is sure."""
    v = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine, cosine = np.linalg.norm(v, axis=1), 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)
    angle, tiny = np.arctan2(sine, cosine), sine < 1e-9
    w = v * (angle / np.where(tiny, 1.0, sine))[:, None]
    w[tiny] = np.where(cosine[tiny, None] > 0.0, v[tiny], [np.pi, 0.0, 0.0])
    return np.asarray(w)


def _count_nees(tally: Tally, run: Run, sequence: list[int], claims: PoseClaims) -> None:
    """NEES of one frame of each sequence and stage: others of the same are not independent of it.

    Which one the seed decides, since the first is no fair sample.
    """
    given = np.asarray(np.isfinite(claims.covariance).all(axis=(1, 2)))
    keys = np.random.default_rng([run.seed, 100]).random(len(given))
    chosen: dict[tuple[int, str], int] = {}
    for i in np.flatnonzero(given).tolist():
        place = (sequence[i], claims.stage[i])
        if place not in chosen or keys[i] > keys[chosen[place]]:
            chosen[place] = i
    picked = list(chosen.values())
    squares = trust.nees(claims.errors[picked], claims.covariance[picked])
    for (_, stage), square in zip(chosen, squares.tolist(), strict=True):
        if np.isfinite(square):
            before = tally.nees.get(stage, [0, 0.0])
            tally.nees[stage] = [before[0] + 1, before[1] + square]
        else:
            tally.add(improper_covariances=1)


def _judge_guides(tally: Tally, run: Run) -> None:
    """Errors of the guides, their protection levels, and which of them mislead."""
    chosen = [pair for pair in zip(run.frames, run.fixes, strict=True) if pair[1].guide is not None]
    if not run.scenario.shows_dock:
        tally.add(hazardous_guide=len(chosen))
        return
    if not chosen:
        return
    claims = guide_claims(chosen)
    errors = claims.sizes()
    limits = GuideClaims(claims.true, claims.claimed, claims.levels).limits()  # those at the true range
    over = errors > limits
    tally.add(hazardous_guide=over.any(axis=1).sum())
    tally.add(**{f"hazardous_{name}": which.sum() for name, which in zip(GUIDE_ERRORS, over.T, strict=True)})
    for name, error, level in zip(GUIDE_ERRORS, errors.T, claims.levels.T, strict=True):
        _spread_error(tally, name, error, level)


def guide_claims(pairs: Sequence[tuple[SpotFrame, Fix]]) -> GuideClaims:
    """What guides say, and what is true."""
    guides = [fix.guide for _, fix in pairs if fix.guide is not None]
    T = np.array([frame.T_dock_cam for frame, _ in pairs])
    x, y, z = -np.einsum("nji,nj->in", T[:, :3, :3], T[:, :3, 3])
    return GuideClaims(
        np.array([(g.bearing_x_rad, g.bearing_y_rad, g.range_m) for g in guides]),
        np.stack([np.arctan2(x, z), np.arctan2(y, z), np.sqrt(x * x + y * y + z * z)], axis=1),
        np.array([(g.pl_bearing_rad, g.pl_range_m) for g in guides]),
    )


def _count_gaps(tally: Tally, run: Run) -> None:
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


def _count_sequences(tally: Tally, run: Run) -> None:
    """How many sequences of a path of draws had an answer by their k-th frame."""
    hold = run.scenario.path.hold
    if run.scenario.path.kind != "draws" or hold == 1:
        return
    tally.add(sequences=len(run.frames) // hold)
    for word in ("accepted", "valid", "guide"):
        by_now = np.logical_or.accumulate(run.flags(word).reshape(-1, hold), axis=1)
        tally.add(**{f"{word}_by_{k + 1}": by_now[:, k].sum() for k in range(hold)})


def _count_blind(tally: Tally, run: Run, lights: Indices) -> None:
    """Answers that outlive the last light by 0.3 s, and how many frames the first light needs to bring one back."""
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
    """Frames (1 is the first with a light) from the end of each time without light to the next answer."""
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


# Shards


@dataclass(frozen=True, slots=True, eq=False)
class Shard:
    """One scenario, one method and the seeds `first` to `stop` - 1; `key` stands for all that its counts depend on."""

    scenario: Scenario
    config: Config
    method: str
    cold: bool
    first: int
    stop: int
    station: Station
    camera: Camera
    key: str
    bound: bool = False

    @property
    def file(self) -> str:
        """Name of the file with its counts."""
        name = re.sub(r"\W+", "-", f"{self.scenario.name}-{self.method}")
        return f"{name}-{self.first}-{self.stop}-{self.key}.json"


def run_shard(shard: Shard) -> dict[str, Any]:
    """Counts of one shard, and the seconds that it took; made in a worker."""
    cv2.setNumThreads(1)
    start, tally = time.perf_counter(), Tally()
    localizer = _localizer(shard)
    for seed in range(shard.first, shard.stop):
        tally.merge(tally_run(run_seed(shard, localizer, seed)))
    return {"key": shard.key, "tally": tally.as_dict(), "seconds": time.perf_counter() - start}


def run_seed(shard: Shard, localizer: _LightDoor, seed: int) -> Run:
    """One seed through the light door; a sequence begins without history."""
    frames = list(spot_frames(shard.scenario, shard.station, shard.camera, seed))
    fixes = []
    for frame in frames:
        if frame.step == 0:
            localizer.forget()
        fixes.append(localizer.process_detections(frame.detections))
    return Run(shard.scenario, seed, frames, fixes, _owed(shard, frames) if shard.bound else None)


def _owed(shard: Shard, frames: Sequence[SpotFrame]) -> np.ndarray:
    """In which frames (N,) the bound of what is possible owes a valid fix."""
    bound = Bound(shard.station, shard.camera, shard.config, cold=shard.cold)
    owed = np.zeros(len(frames), bool)
    for k, frame in enumerate(frames):
        if frame.step == 0:
            bound.forget()
        lights = frame.light[frame.light >= 0]
        owed[k] = bound.owes(frame.detections.t_ns, frame.T_dock_cam, lights)
    return owed


def _localizer(shard: Shard) -> _LightDoor:
    if shard.method == "paper":
        from lumidock.paper import PaperLocalizer

        return PaperLocalizer(shard.station, shard.camera, shard.config.paper, cold=shard.cold)
    from lumidock.localizer import Localizer

    return Localizer(shard.station, shard.camera, shard.config, cold=shard.cold)


# A campaign


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """What was asked for: shards in the order of the table, and an `identity` that is equal for equal requests."""

    shards: Sequence[Shard]
    identity: dict[str, Any]


def plan(
    scenarios: Sequence[Scenario],
    methods: Sequence[str],
    seeds: tuple[int, int],
    station_file: Path,
    camera_file: Path,
    *,
    cold: bool = False,
    bound: bool = False,
) -> Campaign:
    """Cut scenarios x methods x the seeds from `seeds[0]` to before `seeds[1]` into shards. Raises: InputError."""
    station, camera = load_station(station_file), load_camera(camera_file)
    inputs = {path.name: _digest(path.read_bytes()) for path in (station_file, camera_file)}
    shared = {"lumidock": f"{version('lumidock')}+{_source_digest()}", "inputs": inputs, "cold": cold, "bound": bound}
    shards = []
    for scenario in dict.fromkeys(scenario.model_dump_json() for scenario in scenarios):
        parsed = Scenario.model_validate_json(scenario)
        config = validate(Config, parsed.config, f"{parsed.name}: config")
        for method in dict.fromkeys(methods):
            what = shared | {"scenario": scenario, "config": config.model_dump_json(), "method": method}
            for first, stop in _blocks(seeds):
                key = _digest(json.dumps(what | {"seeds": [first, stop]}).encode())[:16]
                shards.append(Shard(parsed, config, method, cold, first, stop, station, camera, key, bound))
    identity = shared | {
        "scenarios": [scenario.model_dump(mode="json") for scenario in scenarios],
        "methods": list(methods),
        "seeds": list(seeds),
        "shards": [shard.file for shard in shards],
    }
    return Campaign(shards, identity)


def _blocks(seeds: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Blocks of seeds; they begin at multiples, so that a longer campaign has the blocks of a shorter one."""
    first = seeds[0]
    while first < seeds[1]:
        stop = min(first - first % _SEEDS_PER_SHARD + _SEEDS_PER_SHARD, seeds[1])
        yield first, stop
        first = stop


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@cache
def _source_digest() -> str:
    """Of all source of the package: counts are not mixed between versions of it."""
    digest = hashlib.sha256()
    package = Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(str(path.relative_to(package)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def prepare(campaign: Campaign, out: Path, *, force: bool = False) -> None:
    """Make the folder of a campaign, or take up the same one again.

    With `force` a folder that holds something else is taken over; shards that this campaign has too are kept.
    Raises: InputError.
    """
    described = out / "campaign.json"
    before = _read_json(described)
    if before != campaign.identity:
        if out.exists() and not out.is_dir():
            raise InputError(f"{out}: is a file")
        if out.exists() and any(out.iterdir()) and not force:
            what = "is of another campaign" if before else "exists"
            raise InputError(f"{out}: {what}; give --force to write into it")
    (out / "shards").mkdir(parents=True, exist_ok=True)
    wanted = set(campaign.identity["shards"])
    for path in (out / "shards").glob("*.json*"):
        if path.name not in wanted:
            path.unlink()
    _write(described, json.dumps(campaign.identity, indent=1))


def run_campaign(
    campaign: Campaign,
    out: Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress = lambda _done, _total: None,
) -> float:
    """Run all shards that have no file in `out` yet; returns frames per second and core, NaN where all were there.

    Over `workers` processes (by default one for each core; 0: in this one), or on the dask cluster at the address
    `cluster`. Raises: InputError; LumidockError when workers keep dying.
    """
    todo = {shard.file: shard for shard in campaign.shards if _read_shard(out, shard) is None}
    total, frames, seconds = len(campaign.shards), 0, 0.0
    progress(total - len(todo), total)
    workers = os.cpu_count() or 1 if workers is None else workers
    for shard, result in _results(list(todo.values()), workers, cluster):
        _write(out / "shards" / shard.file, json.dumps(result))
        del todo[shard.file]
        frames, seconds = frames + result["tally"]["counts"]["frames"], seconds + result["seconds"]
        progress(total - len(todo), total)
    return frames / seconds if seconds else float("nan")


def _results(shards: list[Shard], workers: int, cluster: str | None) -> Iterator[tuple[Shard, dict[str, Any]]]:
    """Counts of shards as they come; when a worker dies, what is left goes to new ones."""
    if cluster is None and not workers:
        yield from ((shard, run_shard(shard)) for shard in shards)
        return
    left = {shard.file: shard for shard in shards}
    for _ in range(_MAX_POOLS):
        with _pool(workers, cluster) as pool:
            for shard, result in _pooled(pool, list(left.values())):
                del left[shard.file]
                yield shard, result
        if not left:
            return
    raise LumidockError(f"workers died {_MAX_POOLS} times; {len(left)} shards are left")


def _pooled(pool: Executor, shards: list[Shard]) -> Iterator[tuple[Shard, dict[str, Any]]]:
    """Counts of shards as they come, but of those that a dead worker had."""
    futures: dict[Future[dict[str, Any]], Shard] = {}
    try:
        for shard in shards:
            futures[pool.submit(run_shard, shard)] = shard
    except BrokenProcessPool:
        pass  # those that were given out say so too
    for future in as_completed(futures):
        try:
            result = future.result()
        except Exception as error:
            if not _worker_died(error):
                raise
        else:
            yield futures[future], result


def _worker_died(error: Exception) -> bool:
    """Whether it was the worker; dask's own error is known by its name, since dask need not be there."""
    return isinstance(error, (BrokenProcessPool, CancelledError)) or type(error).__name__ == "KilledWorker"


@contextmanager
def _pool(workers: int, cluster: str | None) -> Iterator[Executor]:
    """Worker processes here, or those of a dask cluster."""
    if cluster is not None:
        with _dask_client(cluster) as client:
            yield client.get_executor()
        return
    spawn = get_context("spawn")  # a fork would inherit the locks of OpenCV's threads
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=_start_worker) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)


def _dask_client(address: str) -> Any:  # noqa: ANN401
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--cluster needs dask distributed: pip install 'lumidock[cluster]'") from None
    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"--cluster {address}: {error or type(error).__name__}") from None


def _start_worker() -> None:
    """Let Ctrl-C end a worker without a word, and the end of the parent too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _read_shard(out: Path, shard: Shard) -> dict[str, Any] | None:
    """The counts of a shard that was finished before."""
    content = _read_json(out / "shards" / shard.file)
    return content if content and content.get("key") == shard.key else None


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _write(path: Path, text: str) -> None:
    """Write a file so that it is there whole or not at all."""
    partial = path.with_name(f"{path.name}.tmp")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


# The table


def tabulate(campaign: Campaign, out: Path) -> dict[str, Any]:
    """Add up all shards in their order, and write table.json and table.md. Raises: LumidockError for a missing one."""
    tallies: dict[tuple[str, str], Tally] = {}
    for shard in campaign.shards:
        content = _read_shard(out, shard)
        if content is None:
            raise LumidockError(f"{out / 'shards' / shard.file}: is not there")
        place = (shard.scenario.model_dump_json(), shard.method)
        tallies.setdefault(place, Tally()).merge(Tally.from_dict(content["tally"]))
    names = {shard.scenario.model_dump_json(): shard.scenario.name for shard in campaign.shards}
    rows = [{"scenario": names[key], "method": method} | row_of(tally) for (key, method), tally in tallies.items()]
    table = {name: campaign.identity[name] for name in ("lumidock", "inputs", "cold", "seeds")} | {"rows": rows}
    _write(out / "table.json", json.dumps(table, indent=1))
    _write(out / "table.md", markdown(table))
    return table


def row_of(tally: Tally) -> dict[str, Any]:
    """One row of the table: all counts, and what follows from them; angles in degrees, NEES with its frames."""
    errors = {}
    for name in (*POSE_ERRORS, *GUIDE_ERRORS):
        unit, scale = ("deg", _DEG) if name in ("angle", "bearing") else ("m", 1.0)
        errors[f"{name}_{unit}"] = _error_row(tally, name, scale)
    back = {
        word: {"median": tally.quantile(f"frames_back_{word}", 0.5), "max": tally.largest.get(f"frames_back_{word}")}
        for word in ("valid", "guide")
    }
    total = [sum(values) for values in zip(*tally.nees.values(), strict=True)] or [0, 0.0]
    return {
        "counts": dict(sorted(tally.counts.items())),
        "errors": errors,
        "nees": {stage: _mean(*values) for stage, values in [("all", total), *sorted(tally.nees.items())]},
        "longest_gap_s": {word: tally.largest.get(f"gap_s_{word}") for word in ("valid", "guide")},
        "frames_back": back,
    }


def _error_row(tally: Tally, name: str, scale: float) -> dict[str, float | None]:
    """Median, 95 % and largest error and the median level, by `scale`; and the level over the 95 % error."""
    p50, p95 = (tally.quantile(f"error_{name}", share) for share in (0.5, 0.95))
    level, worst = tally.quantile(f"level_{name}", 0.5), tally.largest.get(f"error_{name}")
    values = {"median": p50, "p95": p95, "max": worst, "level_median": level}
    scaled = {key: None if value is None else value * scale for key, value in values.items()}
    return scaled | {"level_over_p95": level / p95 if level and p95 else None}


def _mean(frames: float, total: float) -> dict[str, float | None]:
    return {"frames": frames, "mean": total / frames if frames else None}


def markdown(table: dict[str, Any]) -> str:
    """The table for people: what was answered, what it is worth, how far off it is, how it lasts."""
    parts = [
        f"Seeds {table['seeds'][0]} to {table['seeds'][1] - 1}{', every frame cold' * table['cold']}; "
        f"lumidock {table['lumidock']}.",
        *(_section(title, columns, table["rows"]) for title, columns in _SECTIONS.items()),
    ]
    return "\n\n".join(parts) + "\n"


def _section(title: str, columns: dict[str, Callable[[dict[str, Any]], str]], rows: list[dict[str, Any]]) -> str:
    lines = [f"**{title}**", "", f"| scenario | method | {' | '.join(columns)} |", "|---|---|" + "---|" * len(columns)]
    for row in rows:
        cells = [row["scenario"].replace("|", "/"), row["method"], *(column(row) for column in columns.values())]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _count(name: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: str(row["counts"].get(name, 0))


def _percent(part: str, whole: str) -> Callable[[dict[str, Any]], str]:
    def cell(row: dict[str, Any]) -> str:
        among = row["counts"].get(whole, 0)
        return f"{100.0 * row['counts'].get(part, 0) / among:.3f}" if among else "-"

    return cell


def _of(part: str, whole: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: f"{row['counts'].get(part, 0)} of {row['counts'].get(whole, 0)}"


def _number(*path: str, digits: int = 3) -> Callable[[dict[str, Any]], str]:
    def cell(row: dict[str, Any]) -> str:
        value: Any = row
        for key in path:
            value = value.get(key) if value else None
        return "-" if value is None else f"{value:.{digits}f}"

    return cell


def _error(name: str) -> Callable[[dict[str, Any]], str]:
    cells = [_number("errors", name, key) for key in ("median", "p95", "max")]
    return lambda row: " / ".join(cell(row) for cell in cells)


def _by_frame(word: str) -> Callable[[dict[str, Any]], str]:
    """Share of the sequences with an answer by each of their frames, %."""

    def cell(row: dict[str, Any]) -> str:
        counts = row["counts"]
        shares, k = [], 1
        while f"{word}_by_{k}" in counts:
            shares.append(f"{100.0 * counts[f'{word}_by_{k}'] / counts['sequences']:.2f}")
            k += 1
        return " / ".join(shares) or "-"

    return cell


def _nees(row: dict[str, Any]) -> str:
    cells = [f"{stage} {v['mean']:.2f} ({v['frames']:.0f})" for stage, v in row["nees"].items() if v["frames"]]
    return ", ".join(cells) or "-"


def _level(name: str) -> Callable[[dict[str, Any]], str]:
    cells = _number("errors", name, "level_median"), _number("errors", name, "level_over_p95", digits=1)
    return lambda row: f"{cells[0](row)} ({cells[1](row)})"


_ERRORS = {
    "lateral, m": "lateral_m",
    "axial, m": "axial_m",
    "angle, deg": "angle_deg",
    "bearing, deg": "bearing_deg",
    "range, m": "range_m",
}
_SECTIONS: dict[str, dict[str, Callable[[dict[str, Any]], str]]] = {
    "Answers and names": {
        "runs": _count("runs"),
        "frames": _count("frames"),
        "0-3 lights": _count("frames_few"),
        "4-5": _count("frames_some"),
        "6+": _count("frames_full"),
        "accepted, %": _percent("accepted", "frames"),
        "with 6+, %": _percent("accepted_full", "frames_full"),
        "with 4-5, %": _percent("accepted_some", "frames_some"),
        "names": _count("named"),
        "wrong, coincident": _count("wrong_coincident"),
        "wrong, else": _count("wrong_else"),
        "frames with wrong": _count("frames_with_wrong"),
    },
    "Trust": {
        "valid, %": _percent("valid", "frames"),
        "valid with 6+, %": _percent("valid_full", "frames_full"),
        "valid where owed, %": _percent("valid_eligible", "frames_eligible"),
        "guide, %": _percent("guide", "frames"),
        "guide with 6+, %": _percent("guide_full", "frames_full"),
        "guide with 4-5, %": _percent("guide_some", "frames_some"),
        "hazardous valid": _count("hazardous_valid"),
        "hazardous guide": _count("hazardous_guide"),
        **{f"{name} over level": _of(f"over_level_{name}", f"levels_{name}") for name in (*POSE_ERRORS, *GUIDE_ERRORS)},
        "NEES (frames)": _nees,
    },
    "Errors, median / 95 % / largest": {name: _error(key) for name, key in _ERRORS.items()},
    "Protection levels, median (times the 95 % error)": {name: _level(key) for name, key in _ERRORS.items()},
    "Over time": {
        "accepted by frame, %": _by_frame("accepted"),
        "guide by frame, %": _by_frame("guide"),
        "longest gap valid, s": _number("longest_gap_s", "valid", digits=2),
        "guide, s": _number("longest_gap_s", "guide", digits=2),
        "valid without light for 0.3 s": _of("stale_valid", "frames_stale"),
        "guide so": _of("stale_guide", "frames_stale"),
        "never back": _of("never_back_valid", "blinded_valid"),
        "frames until back, median": _number("frames_back", "valid", "median", digits=0),
        "largest": _number("frames_back", "valid", "max", digits=0),
    },
}

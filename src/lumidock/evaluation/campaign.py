"""A campaign: scenarios x seeds x methods on bare detections (`process_detections`), and what is counted in them.

A shard is one scenario, one method and a block of seeds. Its counts are written into a file of their own as soon as
they are known, so that a campaign that was interrupted continues with the shards that are missing. The table does not
depend on the number of workers: counts and histograms hold integers, and shards are added up in their order.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lumidock.camera import Camera, load_camera
from lumidock.config import Config
from lumidock.errors import InputError, LumidockError
from lumidock.evaluation.campaign_table import markdown, row_of
from lumidock.evaluation.counts import SimulatedRun, Tally, tally_run
from lumidock.evaluation.cramer_rao import Bound
from lumidock.methods import Aided, Method, implementation, localizer_of
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.scenario import Scenario, station_of
from lumidock.station import Station, load_station
from lumidock.yamlfile import validate

_SEEDS_PER_SHARD = 5
_MAX_POOLS = 4  # a worker that dies breaks its pool; after so many broken pools the campaign is given up
Progress = Callable[[int, int | None], None]


# Shards


@dataclass(frozen=True, slots=True, eq=False)
class Shard:
    """One scenario, one method and the seeds `first` to `stop` - 1; `key` hashes all that its counts depend on."""

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
    """Counts of one shard, and the seconds that it took; runs in a worker process."""
    cv2.setNumThreads(1)
    start, tally = time.perf_counter(), Tally()
    localizer = localizer_of(shard.method, shard.station, shard.camera, shard.config, cold=shard.cold)
    for seed in range(shard.first, shard.stop):
        tally.merge(tally_run(run_seed(shard, localizer, seed)))
    return {"key": shard.key, "tally": tally.as_dict(), "seconds": time.perf_counter() - start}


def run_seed(shard: Shard, localizer: Method, seed: int) -> SimulatedRun:
    """One seed through `process_detections`; each sequence of it begins without history."""
    frames = list(simulated_frames(shard.scenario, shard.station, shard.camera, seed))
    fixes = []
    for frame in frames:
        if frame.step == 0:
            localizer.forget()
        if isinstance(localizer, Aided):
            for value in frame.aiding:
                localizer.aid(value)
        fixes.append(localizer.process_detections(frame.detections))
    eligible = _eligible(shard, frames) if shard.bound else None
    return SimulatedRun(shard.scenario, seed, frames, fixes, shard.station.alert_limits, eligible)


def _eligible(shard: Shard, frames: Sequence[SimulatedFrame]) -> np.ndarray:
    """In which frames (N,) the Cramer-Rao bound is far enough inside the alert limits for a valid fix."""
    bound = Bound(shard.station, shard.camera, shard.config, cold=shard.cold)
    eligible = np.zeros(len(frames), bool)
    for k, frame in enumerate(frames):
        if frame.step == 0:
            bound.forget()
        lights = frame.light[frame.light >= 0]
        eligible[k] = bound.allows_valid(frame.detections.t_ns, frame.T_dock_cam, lights)
    return eligible


# A campaign


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """A request: its shards in the order of the table, and an `identity` that is equal for equal requests."""

    shards: Sequence[Shard]
    identity: dict[str, Any]


def plan(
    scenarios: Sequence[Scenario],
    methods: Sequence[str],
    seeds: tuple[int, int],
    station_file: Path | None,
    camera_file: Path,
    *,
    cold: bool = False,
    bound: bool = False,
) -> Campaign:
    """Cut scenarios x methods x the seeds from `seeds[0]` to before `seeds[1]` into shards. Raises: InputError.

    Without a `station_file` every scenario is simulated on the station that it is made for.
    """
    camera = load_camera(camera_file)
    stations = [station_file or station_of(scenario) for scenario in scenarios]
    inputs = {path.name: _digest(path.read_bytes()) for path in (*stations, camera_file)}
    shared = {"lumidock": f"{version('lumidock')}+{source_digest()}", "inputs": inputs, "cold": cold, "bound": bound}
    shards = []
    unique = {scenario.model_dump_json(): path for scenario, path in zip(scenarios, stations, strict=True)}
    for scenario, path in unique.items():
        parsed, station = Scenario.model_validate_json(scenario), load_station(path)
        own_inputs = {name: inputs[name] for name in (path.name, camera_file.name)}
        config = validate(Config, parsed.config, f"{parsed.name}: config")
        for method in dict.fromkeys(methods):
            what = shared | {
                "inputs": own_inputs,
                "scenario": scenario,
                "config": config.model_dump_json(),
                "method": method,
            }
            if code := implementation(method):
                what |= {"implementation": code}
            for first, stop in _blocks(seeds):
                key = _digest(json.dumps(what | {"seeds": [first, stop]}).encode())[:16]
                shard = Shard(
                    parsed, config, method, cold, first, stop, station=station, camera=camera, key=key, bound=bound
                )
                shards.append(shard)
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
def source_digest() -> str:
    """Hash of the package's source and measured tables, so that counts of different versions are never mixed."""
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted((*package.rglob("*.py"), *package.rglob("*.json"))):
        digest.update(str(path.relative_to(package)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def prepare(campaign: Campaign, out: Path, *, force: bool = False) -> None:
    """Make the folder of a campaign, or continue in the folder of the same one.

    With `force` a folder that holds something else is used too; of its shards those that this campaign has are kept.
    Raises: InputError.
    """
    described = out / "campaign.json"
    before = read_json(described)
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
    write_whole(described, json.dumps(campaign.identity, indent=1))


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
        write_whole(out / "shards" / shard.file, json.dumps(result))
        del todo[shard.file]
        frames, seconds = frames + result["tally"]["counts"]["frames"], seconds + result["seconds"]
        progress(total - len(todo), total)
    return frames / seconds if seconds else float("nan")


def _results(shards: list[Shard], workers: int, cluster: str | None) -> Iterator[tuple[Shard, dict[str, Any]]]:
    """Counts of shards as they are finished; when a worker dies, the shards that are left go to a new pool."""
    if cluster is None and not workers:
        yield from ((shard, run_shard(shard)) for shard in shards)
        return
    left = {shard.file: shard for shard in shards}
    for _ in range(_MAX_POOLS):
        with worker_pool(workers, cluster) as pool:
            for shard, result in _pooled(pool, list(left.values())):
                del left[shard.file]
                yield shard, result
        if not left:
            return
    raise LumidockError(f"workers died {_MAX_POOLS} times; {len(left)} shards are left")


def _pooled(pool: Executor, shards: list[Shard]) -> Iterator[tuple[Shard, dict[str, Any]]]:
    """Counts of shards as they are finished, except those whose worker died."""
    futures: dict[Future[dict[str, Any]], Shard] = {}
    try:
        for shard in shards:
            futures[pool.submit(run_shard, shard)] = shard
    except BrokenProcessPool:
        pass  # the futures of the shards that were submitted raise the same error below
    for future in as_completed(futures):
        try:
            result = future.result()
        except Exception as error:
            if not _worker_died(error):
                raise
        else:
            yield futures[future], result


def _worker_died(error: Exception) -> bool:
    """Whether the worker died; dask's own error is recognised by its name, since dask need not be installed."""
    return isinstance(error, (BrokenProcessPool, CancelledError)) or type(error).__name__ == "KilledWorker"


@contextmanager
def worker_pool(workers: int, cluster: str | None) -> Iterator[Executor]:
    """Worker processes on this machine, or those of a dask cluster."""
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
    """Let a worker end silently at Ctrl-C, and when its parent process ends."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _read_shard(out: Path, shard: Shard) -> dict[str, Any] | None:
    """The counts of a shard that an earlier call finished; None where there are none."""
    content = read_json(out / "shards" / shard.file)
    return content if content and content.get("key") == shard.key else None


def read_json(path: Path) -> dict[str, Any] | None:
    """The mapping in a JSON file; None where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def write_whole(path: Path, text: str) -> None:
    """Write a file so that, when the program is killed, it is either complete or absent."""
    partial = path.with_name(f"{path.name}.tmp")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


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
    write_whole(out / "table.json", json.dumps(table, indent=1))
    write_whole(out / "table.md", markdown(table))
    return table

"""The outlook's adaptive tuning: the swarm's coefficients by racing, and what they gain on layouts held out of it.

Racing by successive halving (K. Jamieson, A. Talwalkar, 2016): many candidates on few frames, the better half on twice
as many, until one is left. The size of the swarm is fixed, since a larger one is always better.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lumidock.camera import Camera
from lumidock.config import PsoConfig
from lumidock.paper.pso import register
from lumidock.report.page import PageSection, Table
from lumidock.reproduce.intervals import share
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.layouts import LAYOUTS, with_layout
from lumidock.reproduce.plan import Dock, Plan
from lumidock.reproduce.trials import SWARMS
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.scenario import load_scenario
from lumidock.station import Station

_TRAINED_ON = LAYOUTS[1]
_START = SWARMS["20 x 40, wide bounds"]
_MISSING = 3
# ranges of the coefficients: published swarms have inertia 0.4-0.9 and pulls up to 2.5
_RANGES = {"inertia": (0.4, 0.95), "c1": (0.2, 3.0), "c2": (0.2, 3.0), "k": (0.4, 1.2), "stagnation": (4, 40)}
_TEXT = (
    "The paper's outlook proposes to tune the swarm adaptively. Here inertia, both pulls, velocity scale and restart "
    "are raced on one layout with three lights missing, for a swarm of 20 x 40, and the winner is measured on new "
    "frames of that layout and on the layouts that it has not seen."
)


def jobs(plan: Plan) -> list[Job]:
    """One job."""
    grid = plan.grid
    return [Job("tuning", 0.1 * grid.draws, race, (plan.dock, grid.tuned, 4 * grid.draws, grid.first_seed))]


def race(dock: Dock, candidates: int, count: int, seed: int) -> dict[str, Any]:
    """The winner among the start and random candidates, and how often both are right on `count` frames a layout."""
    station, camera = dock.load()
    rng = np.random.default_rng([seed, 6])
    field = [_START, *(_drawn(rng) for _ in range(candidates - 1))]
    frames = _frames(dock, _TRAINED_ON, count, seed)
    rounds, used = [], max(10, count >> int(np.log2(candidates)))
    trained = with_layout(station, _TRAINED_ON)
    while len(field) > 1:
        right = [_right(config, trained, frames[:used], camera) for config in field]
        order = np.argsort(-np.array(right), kind="stable")[: len(field) // 2]
        rounds.append([len(field), min(used, len(frames)), max(right)])
        field, used = [field[i] for i in order], 2 * used
    winner, results = field[0], {}
    for layout in LAYOUTS:
        test = _frames(dock, layout, count, seed + 1)
        laid_out = with_layout(station, layout)
        scores = [_right(config, laid_out, test, camera) for config in (_START, winner)]
        results[layout] = {"frames": len(test), "start": scores[0], "winner": scores[1]}
    found = {name: getattr(winner, name) for name in _RANGES}
    before = {name: getattr(_START, name) for name in _RANGES}
    return {"rounds": rounds, "layouts": results, "winner": found, "start": before}


def _drawn(rng: np.random.Generator) -> PsoConfig:
    """A random candidate; pulls fall from a larger to a smaller value, as in eqs. (5) and (6)."""
    pull = {name: tuple(sorted(map(float, rng.uniform(*_RANGES[name], 2)), reverse=True)) for name in ("c1", "c2")}
    inertia, k = (float(rng.uniform(*_RANGES[name])) for name in ("inertia", "k"))
    stagnation = round(rng.uniform(*_RANGES["stagnation"]))
    return _START.model_copy(update={"inertia": inertia, "k": k, "stagnation": stagnation, **pull})


def _frames(dock: Dock, layout: str, count: int, seed: int) -> list[SimulatedFrame]:
    station, camera = dock.load()
    settings = (f"path.count={count}", f"faults.missing={_MISSING}", "detections.rear_range_m=0.01")
    return list(simulated_frames(load_scenario("missing-3", settings), with_layout(station, layout), camera, seed))


def _right(config: PsoConfig, station: Station, frames: list[SimulatedFrame], camera: Camera) -> int:
    """How many frames the swarm associates right, without history."""
    front, rng = station.lights_of(station.layers_front_to_rear()[0]), np.random.default_rng(config.seed)
    lights_xy, right = station.p_dock[front, :2], 0
    for frame in frames:
        ray = camera.unproject(frame.detections.uv)
        found = register(ray[:, :2] / ray[:, 2:] * [1.0, -1.0], lights_xy, None, config, rng)
        right += np.array_equal(np.where(found.light >= 0, front[found.light], -1), frame.light)
    return right


def section(_plan: Plan, results: Mapping[str, Any]) -> PageSection:
    """What the race chose, and what it is worth on each layout."""
    r = results["tuning"]
    rows = []
    for layout, found in r["layouts"].items():
        kind = "trained on, other frames" if layout == _TRAINED_ON else "held out"
        cells = [share(found[who], found["frames"]) for who in ("start", "winner")]
        rows.append([f"{layout} ({kind})", str(found["frames"]), *cells])
    chosen = "; ".join(f"{name} {_short(r['start'][name])} -> {_short(r['winner'][name])}" for name in _RANGES)
    caption = f"Swarm of 20 x 40, three lights missing, no history. The race changed {chosen}."
    table = Table(caption, ["layout", "frames", "before, right %", "tuned, right %"], rows)
    return PageSection("Adaptive tuning of the swarm", _TEXT, items=[table])


def _short(value: Any) -> str:  # noqa: ANN401  # a number or a pair of them, as JSON has it
    return " to ".join(f"{v:.2f}" for v in value) if isinstance(value, (list, tuple)) else f"{value:.3g}"

"""Where to put the lights of a dock that is not built yet: the layout whose worst case along the approach is best.

Covariance matrix adaptation (N. Hansen, "The CMA Evolution Strategy: A Tutorial", 2016) over the places that the dock's
structure offers. The worst case: the largest protection level over its alert limit, with any so many lights dead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array
from lumidock.errors import InputError, extra
from lumidock.evaluation.dead_lights import (
    NO_LEVEL,
    Approach,
    dead_sets,
    least_confusion_m,
    level_ratios,
    seen_along,
)
from lumidock.setup.observations import LEAST_LIGHTS
from lumidock.setup.station_files import write_station_file
from lumidock.station import Color, Name, Station, Vector, load_station
from lumidock.yamlfile import read_mapping, validate

_WORST_SETS, _NEW_SETS = 3, 1  # of dead lights in one evaluation: those that were worst lately, and others by chance
_SEARCH_HZ = 0.5  # steps of the bound in the search; the layout that is found is judged at four times that
_FORGET = 0.9  # how much of a set's last ratio counts when it was not tried again
_FIRST_SPREAD = 0.25  # of a rail's length
_SPACING_WEIGHT, _CONFUSION_WEIGHT = 20.0, 100.0  # cost per m that is missing; twice the ratio costs 0.3
_CENTIMETRES = 2  # decimals of a position in m

Positive = Annotated[float, Field(gt=0.0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class Place(_Strict):
    """A rail from `corner` along one vector, or a surface along two, that holds so many `lights` of one layer."""

    layer: Name
    lights: Annotated[int, Field(ge=1, le=40)]
    corner: Vector
    along: Vector
    across: Vector | None = None
    color: Color = "white"
    axis: Vector = (0.0, 0.0, 1.0)
    beam_deg: Annotated[float, Field(gt=0, le=360)] = 120.0
    power_w: Positive = 2.0


class Box(_Strict):
    """A box without lights, by two of its corners."""

    low: Vector
    high: Vector


class Spec(_Strict):
    """What a dock's structure offers and what is asked of it; a design file holds these keys."""

    schema_: Annotated[Literal[1], Field(alias="schema")]
    name: Annotated[str, Field(min_length=1, max_length=64)]
    docking_point: Vector = (0.0, 0.0, 0.0)
    places: Annotated[list[Place], Field(min_length=1)]
    keep_out: list[Box] = []
    dead: Annotated[int, Field(ge=0, le=2)] = 2
    from_z_m: float = 20.0
    speed_m_s: Positive = 0.2
    reach_m: dict[Color, float] = {"white": 27.0, "blue": 21.0}
    confusion_m: Annotated[float, Field(ge=0.0)] = 0.085
    roll_deg: Annotated[float, Field(ge=0.0, le=180.0)] = 15.0
    spacing_m: Annotated[float, Field(ge=0.0)] = 0.25
    seed: Annotated[int, Field(ge=1, le=10**9)] = 1
    evaluations: Annotated[int, Field(ge=20, le=100_000)] = 400


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """A layout: the `content` of its station file, the station, its cost and how many layouts were tried."""

    content: dict[str, Any]
    station: Station
    cost: float
    evaluations: int


def load_spec(path: Path) -> Spec:
    """Read a design file. Raises: InputError, one line, for anything the schema refuses."""
    return validate(Spec, read_mapping(path), str(path))


def approach_of(spec: Spec, station: Station) -> Approach:
    """The approach that a layout is judged on. Raises: InputError for a colour whose reach is not given."""
    missing = [color for color in station.color if color not in spec.reach_m]
    if missing:
        raise InputError(f"{spec.name}: reach_m says nothing of {missing[0]} lights")
    reach = np.array([spec.reach_m[color] for color in station.color])
    return Approach(spec.from_z_m, spec.docking_point[2], spec.speed_m_s, reach)


def design(
    spec: Spec,
    camera: Camera,
    config: Config,
    work: Path,
    progress: Callable[[int, int | None], None] = lambda _done, _total: None,
) -> Design:
    """The best layout found within the spec's evaluations; `work` is a file that station files are written to.

    The same spec gives the same layout. Raises: InputError when cma is not installed (extra `setup`).
    """
    with extra("setup"):
        import cma
    size = sum(place.lights * (1 if place.across is None else 2) for place in spec.places)
    judge = _Judge(spec, camera, config, work)
    options = {"bounds": [0.0, 1.0], "seed": spec.seed, "verbose": -9, "maxfevals": spec.evaluations}
    start = np.random.default_rng(spec.seed).uniform(0.2, 0.8, size)
    search = cma.CMAEvolutionStrategy(start, _FIRST_SPREAD, options)
    best, best_cost = start, np.inf
    while not search.stop():
        asked = search.ask()
        costs = [judge.cost(np.asarray(u)) for u in asked]
        search.tell(asked, costs)
        progress(judge.evaluations, spec.evaluations)
        # a set that was not tried flatters a layout, so what seems better than the best is judged by all of them
        u = np.asarray(asked[int(np.argmin(costs))])
        if min(costs) < best_cost and (cost := judge.full_cost(u, best_cost)) < best_cost:
            best, best_cost = u, cost
    content = layout(spec, best)
    return Design(content, judge.station(best), best_cost, judge.evaluations)


def layout(spec: Spec, u: Array) -> dict[str, Any]:
    """The content of the station file that coordinates `u` (n,) from 0 to 1 along the places stand for."""
    lights, k, count = [], 0, dict[str, int]()
    for place in spec.places:
        dims = 1 if place.across is None else 2
        for _ in range(place.lights):
            at = np.array(place.corner) + u[k] * np.array(place.along)
            if place.across is not None:
                at = at + u[k + 1] * np.array(place.across)
            k += dims
            count[place.layer] = count.get(place.layer, 0) + 1
            lights.append(
                {
                    "id": f"{place.layer[:1].upper()}{count[place.layer]}",
                    "layer": place.layer,
                    "position": [round(float(x), _CENTIMETRES) + 0.0 for x in at],
                    "color": place.color,
                    "axis": list(place.axis),
                    "beam_deg": place.beam_deg,
                    "power_w": place.power_w,
                }
            )
    return {"schema": 1, "name": spec.name, "docking_point": list(spec.docking_point), "lights": lights}


class _Judge:
    """What layouts cost; remembers which sets of dead lights were bad, as places in the spec, not as positions."""

    def __init__(self, spec: Spec, camera: Camera, config: Config, work: Path) -> None:
        self.spec, self.camera, self.config, self.work = spec, camera, config, work
        self.evaluations = 0
        self._dead = dead_sets(sum(place.lights for place in spec.places), spec.dead)
        self._bad = np.ones(len(self._dead))
        self._rng = np.random.default_rng([spec.seed, 1])

    def station(self, u: Array) -> Station:
        write_station_file(layout(self.spec, u), self.work, "")
        return load_station(self.work)

    def cost(self, u: Array) -> float:
        """Cost by the sets of dead lights that were worst lately and a few others."""
        self.evaluations += 1
        worst = np.argsort(-self._bad, kind="stable")[:_WORST_SETS]
        others = self._rng.choice(len(self._dead), min(_NEW_SETS, len(self._dead)), replace=False)
        return self._judged(u, sorted({*worst.tolist(), *others.tolist()}))

    def full_cost(self, u: Array, enough: float) -> float:
        """Cost by all sets of dead lights, or one above `enough` as soon as it is known to be."""
        return self._judged(u, np.argsort(-self._bad, kind="stable").tolist(), enough)

    def _judged(self, u: Array, sets: list[int], enough: float = np.inf) -> float:
        try:
            station = self.station(u)
        except InputError:  # two lights at one place, or all in one place
            return 10.0
        approach = replace(approach_of(self.spec, station), step_hz=_SEARCH_HZ)
        seen = seen_along(station, self.camera, approach)
        self._bad *= _FORGET
        always, worst = self._faults(station) + self._blind(seen, approach), -np.inf
        for k in sets:
            lit = seen & ~np.isin(np.arange(len(station)), self._dead[k])
            self._bad[k] = _badness(level_ratios(station, self.camera, self.config, approach, lit))
            worst = max(worst, float(self._bad[k]))
            if worst + always > enough:
                break
        return worst + always

    def _blind(self, seen: np.ndarray, approach: Approach) -> float:
        """The share of the approach where some set of dead lights leaves fewer than four in view, for a start."""
        judged = approach.z_m() <= approach.from_z_m
        left = np.array([(seen[judged] & ~np.isin(np.arange(seen.shape[1]), dead)).sum(axis=1) for dead in self._dead])
        return float((left.min(axis=0) < LEAST_LIGHTS).mean())

    def confusion_m(self, station: Station) -> dict[str, float]:
        return least_confusion_m(station, np.deg2rad(self.spec.roll_deg))

    def _faults(self, station: Station) -> float:
        """What confusion, lights too near to each other and lights in keep-out boxes cost."""
        gaps = np.linalg.norm(station.p_dock[:, None] - station.p_dock[None], axis=2)
        gaps[np.diag_indices(len(gaps))] = np.inf
        crowded = np.maximum(self.spec.spacing_m - gaps.min(axis=1), 0.0).sum()
        alike = sum(max(self.spec.confusion_m - least, 0.0) for least in self.confusion_m(station).values())
        inside = sum(
            bool(((p >= box.low) & (p <= box.high)).all()) for p in station.p_dock for box in self.spec.keep_out
        )
        return float(_SPACING_WEIGHT * crowded + _CONFUSION_WEIGHT * alike + inside)


def _badness(ratio: Array) -> float:
    """One number for the ratios (K,) along an approach: the worst counts, and a little how long it stays over one."""
    logs = np.log10(np.clip(ratio, 1e-3, NO_LEVEL))
    return float(logs.max() + np.maximum(logs, 0.0).mean())

"""What a dock loses with lights dead at a slow approach, which lights a warning is about, and which one to move.

A move is found by trial: each light that takes part is shifted along each axis, and the shift that helps most is told.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array
from lumidock.evaluation.confusion import apparent, worst_confusion
from lumidock.evaluation.dead_lights import NO_LEVEL, Approach, Strength, dead_sets, level_ratios, seen_along, strength
from lumidock.evaluation.station_check import head_on, in_view
from lumidock.station import Station

_STEP_HZ = 1.0  # of the bound: 0.2 m at 0.2 m/s
_MOST_SETS = 250  # of dead lights that are tried, a few seconds: any two of 21 lights
_LEVEL_MOVE_M, _CONFUSION_MOVE_M = 0.25, 0.10  # tried moves: what a bracket bridges, and what a clamp slides
_HELPS = 1.2  # by what factor a move has to better a figure to be worth telling
_DIRECTIONS = {f"{sign}{axis}": float(f"{sign}1") * np.eye(3)[k] for k, axis in enumerate("xyz") for sign in "+-"}


def dead_light_rows(
    station: Station, camera: Camera, config: Config, approach: Approach, most: int
) -> list[dict[str, Any]]:
    """For none, any one, ... any `most` lights dead: the worst level over its limit, where, with which lights dead.

    `not_valid` lists stretches [from z, to z] in m of the approach with a ratio of 1 or more. Sizes whose sets are more
    than can be tried in a few seconds are left out.
    """
    slow, rows = replace(approach, step_hz=_STEP_HZ), []
    for size in range(min(most, len(station) - 1) + 1):
        sets = [dead for dead in dead_sets(len(station), size) if len(dead) == size]
        if len(sets) > _MOST_SETS:
            break
        rows.append(_row(station, size, strength(station, camera, config, slow, sets)))
    return rows


def _row(station: Station, size: int, judged: Strength) -> dict[str, Any]:
    at = int(judged.ratio.argmax())
    return {
        "dead": size,
        "worst": float(judged.ratio[at]),
        "z_m": float(judged.z_m[at]),
        "lights": [station.ids[i] for i in judged.dead[int(judged.worst[at])]],
        "not_valid": _stretches(judged.z_m, judged.ratio >= 1.0),
    }


def _stretches(z_m: Array, bad: np.ndarray) -> list[list[float]]:
    """Where consecutive places (K,) are bad, as [from, to]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(int)))
    return [[float(z_m[a]), float(z_m[b - 1])] for a, b in edges.reshape(-1, 2)]


def warnings(
    station: Station, camera: Camera, config: Config, approach: Approach, checked: dict[str, Any]
) -> list[str]:
    """A line for each thing that deserves a change: what `station_check` has found, and the rows of `dead_lights`."""
    return [
        *_one_plane(station),
        *_level_warnings(station, camera, config, approach, checked["dead_lights"]),
        *_confusion_warnings(station, checked),
    ]


def _one_plane(station: Station) -> list[str]:
    """Whether all lights stand in one plane, where a tilt looks like a sideways shift."""
    away = station.p_dock - station.p_dock.mean(axis=0)
    thickness = float(np.linalg.svd(away, compute_uv=False)[2]) / len(away) ** 0.5
    extent = float(np.linalg.norm(away, axis=1).max())
    if thickness > 0.02 * extent:  # a depth of 2 % of the size changes a picture no more than the detector's errors do
        return []
    return [
        "all lights stand in one plane: from afar a tilt looks like a sideways shift; put one or more at another depth"
    ]


def _level_warnings(
    station: Station, camera: Camera, config: Config, approach: Approach, rows: list[dict[str, Any]]
) -> Iterator[str]:
    """The first number of dead lights that leaves the pose invalid somewhere, with what helps there."""
    row = next((one for one in rows if one["not_valid"]), None)
    if row is None:
        return
    what = {0: "with all lights lit", 1: "with one light dead", 2: "with two lights dead"}[row["dead"]]
    where = ", ".join(f"{a:.1f} to {b:.1f}" for a, b in row["not_valid"])
    dead = np.isin(station.ids, row["lights"])
    view = in_view(station, camera, head_on(row["z_m"]))
    left = [
        light for light, seen, out in zip(station.ids, view.inside & view.toward, dead, strict=True) if seen and not out
    ]
    without = f" without {' '.join(row['lights'])}" if row["lights"] else ""
    yield (
        f"{what} a pose is not valid everywhere (z {where} m); worst at {row['z_m']:.1f} m{without},"
        f" where {' '.join(left) or 'no light'} can be seen;"
        f" {_level_move(station, camera, config, replace(approach, step_hz=_STEP_HZ), dead)}"
    )


def _level_move(station: Station, camera: Camera, config: Config, approach: Approach, dead: np.ndarray) -> str:
    """The move of one lit light that lowers the ratio most, with these lights dead."""

    def ratio(one: Station) -> tuple[float, float]:
        ratios = level_ratios(one, camera, config, approach, seen_along(one, camera, approach) & ~dead)
        return float(ratios.max()), float(np.minimum(ratios, NO_LEVEL).mean())

    before, best, told = ratio(station), ratio(station), ""
    for light in np.flatnonzero(~dead):
        for name, direction in _DIRECTIONS.items():
            after = ratio(_moved(station, int(light), _LEVEL_MOVE_M * direction))
            if after < best:
                best, told = after, f"move {station.ids[light]} by {_LEVEL_MOVE_M:g} m along {name}"
    if before[0] > _HELPS * best[0]:
        return f"{told}: {before[0]:.2f} times the limit becomes {best[0]:.2f}"
    if before[1] > _HELPS * best[1]:
        return f"{told}: the mean along the approach goes from {before[1]:.2f} to {best[1]:.2f} times the limit"
    return f"no move of one light by {_LEVEL_MOVE_M:g} m helps: add a light that is seen there"


def _confusion_warnings(station: Station, checked: dict[str, Any]) -> Iterator[str]:
    """For each layer of which four lights fail the check: the move that parts them best."""
    failing = {text.split(":")[0].removeprefix("layer ") for text in checked["failed"] if text.startswith("layer ")}
    for layer in station.layers_front_to_rear():
        if layer in failing:
            yield f"layer {layer} is easily confused: {_confusion_move(station, layer)}"


def _confusion_move(station: Station, layer: str) -> str:
    lights = station.lights_of(layer)

    def misfit_m(one: Station) -> tuple[float, set[int]]:
        p = apparent(one.p_dock[lights])
        found = [worst_confusion(p, seen=min(4, len(lights)), mirrored=mirrored) for mirrored in (False, True)]
        worst = min(found, key=lambda confusion: confusion.residual_m)
        return worst.residual_m, {*worst.seen, *worst.taken_for}

    before, involved = misfit_m(station)
    best, told = before, ""
    for k in sorted(involved):
        for name, direction in _DIRECTIONS.items():
            after, _ = misfit_m(_moved(station, int(lights[k]), _CONFUSION_MOVE_M * direction))
            if after > best:
                best, told = after, f"move {station.ids[lights[k]]} by {_CONFUSION_MOVE_M:g} m along {name}"
    if best > _HELPS * before:
        return f"{told}: the worst misfit of {before:.3f} m becomes {best:.3f} m"
    return f"no move of one light by {_CONFUSION_MOVE_M:g} m parts more than one pair; place its lights at uneven steps"


def _moved(station: Station, light: int, by_m: Array) -> Station:
    p_dock = station.p_dock.copy()
    p_dock[light] += by_m
    return replace(station, p_dock=p_dock)

"""What a dock still gives with lights dead: protection levels over alert limits along a slow approach, and confusion.

The levels are the localizer's own bound (`cramer_rao.Bound`), at a lower frame rate with as much less noise, so that an
approach at 0.2 m/s takes a fraction of a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Indices
from lumidock.evaluation.confusion import CONFUSED_WITHIN_RAD, apparent, worst_confusion
from lumidock.evaluation.cramer_rao import Bound
from lumidock.evaluation.station_check import head_on, in_view
from lumidock.station import Station

_FRAME_RATE_HZ = 15.0  # of the camera; the bound takes fewer steps, each with the noise of the frames it stands for
_RUN_IN_M = 4.0
NO_LEVEL = 20.0  # the ratio where there is no level at all, and the most that one counts


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """A head-on approach from `from_z_m` to `to_z_m` at `speed_m_s`, in water that shows light i to `reach_m` (M,).

    The bound takes `step_hz` steps a second.
    """

    from_z_m: float
    to_z_m: float
    speed_m_s: float
    reach_m: Array
    step_hz: float = 2.0

    def z_m(self) -> Array:
        """Where the bound is taken (K,), from afar to near; it begins before what is judged, as a docking does."""
        steps = round((self.from_z_m + _RUN_IN_M - self.to_z_m) / self.speed_m_s * self.step_hz)
        return np.asarray(self.from_z_m + _RUN_IN_M - np.arange(steps + 1) * self.speed_m_s / self.step_hz)


def seen_along(station: Station, camera: Camera, approach: Approach) -> np.ndarray:
    """Which lights are seen at each place of an approach (K, M)."""
    out = np.zeros((len(approach.z_m()), len(station)), bool)
    for k, z in enumerate(approach.z_m()):
        T_dock_cam = head_on(float(z))
        near = np.linalg.norm(T_dock_cam[:3, 3] - station.p_dock, axis=1) < approach.reach_m
        out[k, in_view(station, camera, T_dock_cam).lights] = True
        out[k] &= near
    return out


def level_ratios(station: Station, camera: Camera, config: Config, approach: Approach, seen: np.ndarray) -> Array:
    """The largest of the protection levels over their alert limits at each place (K,), with the lights `seen` (K, M).

    `NO_LEVEL` where the bound gives none, and 0 before the part of the approach that is judged.
    """
    noise = config.match.noise_px * (approach.step_hz / _FRAME_RATE_HZ) ** 0.5
    slower = config.model_copy(update={"match": config.match.model_copy(update={"noise_px": noise})})
    bound, out = Bound(station, camera, slower), np.full(len(seen), NO_LEVEL)
    for k, z in enumerate(approach.z_m()):
        level = bound.step(
            round(k * 1e9 / approach.step_hz), head_on(float(z)), np.flatnonzero(seen[k]).astype(np.int64)
        )
        if z > approach.from_z_m + 1e-9:
            out[k] = 0.0
        elif level is not None and np.isfinite(level[:3]).all():
            limits = np.array(station.alert_limits.of_pose(float(z), float(level[1])))
            out[k] = min(float(np.max(level[:3] / limits)), NO_LEVEL) if (limits > 0.0).all() else NO_LEVEL
    return out


def dead_sets(lights: int, most: int) -> list[tuple[int, ...]]:
    """Every set of at most `most` of so many lights, the empty one first."""
    return [dead for size in range(most + 1) for dead in combinations(range(lights), size)]


@dataclass(frozen=True, slots=True, eq=False)
class Strength:
    """The worst ratio at each place (K,) over all sets of dead lights, and which set (K,) of `dead` makes it.

    `alone` (M,) is the worst ratio of the whole approach over the sets that hold light i.
    """

    z_m: Array
    ratio: Array
    worst: Indices
    dead: Sequence[tuple[int, ...]]
    alone: Array


def strength(
    station: Station, camera: Camera, config: Config, approach: Approach, dead: Sequence[tuple[int, ...]]
) -> Strength:
    """Levels over limits along an approach, the worst over sets of dead lights."""
    seen = seen_along(station, camera, approach)
    ratios = np.array(
        [
            level_ratios(station, camera, config, approach, seen & ~np.isin(np.arange(len(station)), lights))
            for lights in dead
        ]
    )
    each = ratios.max(axis=1)
    alone = np.array([max([each[k] for k, d in enumerate(dead) if i in d], default=0.0) for i in range(len(station))])
    return Strength(approach.z_m(), ratios.max(axis=0), ratios.argmax(axis=0), dead, alone)


def least_confusion_m(station: Station, max_roll_rad: float = CONFUSED_WITHIN_RAD) -> dict[str, float]:
    """Per layer, the residual in m of the wrong assignment, mirror images included, that fits four lights best.

    Lights of one layer at different depths are compared as they appear from afar, so that depth counts.
    """
    out = {}
    for layer in station.layers_front_to_rear():
        p = apparent(station.p_dock[station.lights_of(layer)])
        seen = min(4, len(p))
        worst = [
            worst_confusion(p, seen=seen, max_roll_rad=max_roll_rad, mirrored=mirrored).residual_m
            for mirrored in (False, True)
        ]
        out[layer] = min(worst) if seen >= 3 else float("inf")
    return out

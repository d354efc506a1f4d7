"""What the default detector makes of lights, as measured on rendered frames, for bare detections that err as it does.

A table lies beside this file; `python -m bench detector-errors` measures it anew and says on which frames.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Indices
from lumidock.errors import InputError
from lumidock.sim.scenario import Scenario, load_scenario

TABLE = "detector_errors.json"
KINDS = ("front", "rear", "false")  # spots of lights by layer, and those of nothing that the scenario calls a light
_PICTURE = {
    "water",
    "daylight",
    "lamps",
    "around",
    "matter",
    "lens",
    "sensor",
    "output",
}  # what decides how a light looks


@dataclass(frozen=True, slots=True, eq=False)
class DetectionTable:
    """S spots, those of one frame in a row.

    The `frame` of each (S,), true pixels `uv` (S, 2), its `light` (S,), -1 for none, and how far away that is,
    `range_m` (S,): of a false spot of the detector how far the dock is, of a spurious light NaN.
    """

    frame: Indices
    uv: Array
    light: Indices
    range_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """What the detector says of S spots: errors `off_px` (S, 2), `cov_px2` (S, 2, 2), `p_light` and `p_rear` (S,)."""

    off_px: Array
    cov_px2: Array | None
    p_light: Array
    p_rear: Array


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One kind of spot in one band of range.

    `rate`: the share of lights that are found, or false spots a frame; `spots` (K, 4) found ones: sigma px along the
    error by the covariance, error of the centre over that (0 for false ones), p_light, and p_rear (NaN: unknown).
    """

    rate: float
    detections: Array


@dataclass(frozen=True, slots=True, eq=False)
class DetectorErrors:
    """Cells by kind and band; `edges_m` are where the bands of range begin, the last has no end."""

    edges_m: Array
    cells: dict[str, tuple[Cell, ...]]

    def band(self, range_m: Array) -> Indices:
        """The band of each range, of any shape."""
        return np.asarray(np.maximum(np.searchsorted(self.edges_m, range_m, side="right") - 1, 0))

    def rate(self, kind: str, range_m: Array) -> Array:
        """The rate at each range, of any shape."""
        return np.asarray(np.array([cell.rate for cell in self.cells[kind]])[self.band(range_m)])

    def found(self, rear: np.ndarray, range_m: Array, rng: np.random.Generator) -> np.ndarray:
        """Which lights (N, M) at ranges `range_m` (N, M) are found if lit; which are `rear` (M,)."""
        rate = np.where(rear, self.rate("rear", range_m), self.rate("front", range_m))
        return np.asarray(rng.random(range_m.shape) < rate)

    def draw(self, kind: str, range_m: Array, rng: np.random.Generator) -> Array:
        """One of the measured spots (N, 4) for each range (N,)."""
        band, drawn = self.band(range_m), np.full((len(range_m), 4), np.nan)
        for k, cell in enumerate(self.cells[kind]):
            here = np.flatnonzero(band == k)
            if len(here):
                drawn[here] = cell.detections[rng.integers(len(cell.detections), size=len(here))]
        return drawn


@cache
def measured_table() -> dict[str, Any]:
    """The file: `about`, `edges_m`; by scenario, kind and band how many there were, were seen, and some of these."""
    content: dict[str, Any] = json.loads((files("lumidock.sim") / TABLE).read_text(encoding="utf-8"))
    return content


@cache
def detector_errors(name: str) -> DetectorErrors:
    """What was measured on frames of the shipped scenario `name`. Raises: InputError when it was not."""
    table = measured_table()
    if name not in table["scenarios"]:
        raise InputError(f"detections.detector: {name} is not measured; there are {', '.join(table['scenarios'])}")
    cells = {kind: tuple(map(_cell, table["scenarios"][name][kind])) for kind in KINDS}
    return DetectorErrors(np.array(table["edges_m"]), cells)


def _cell(content: dict[str, Any]) -> Cell:
    """Where nothing was found nothing will be."""
    return Cell(content["seen"] / max(content["of"], 1), np.array(content["detections"], float).reshape(-1, 4))


def measured_like(scenario: Scenario) -> str:
    """The measured scenario whose lights look like those of `scenario`. Raises: InputError when there is none."""
    for name in measured_table()["scenarios"]:
        if same_picture(load_scenario(name), scenario):
            return str(name)
    raise InputError(f"{scenario.name}: no detector errors were measured on such pictures")


def same_picture(one: Scenario, other: Scenario) -> bool:
    """Whether a light looks the same in both; path and faults may differ."""
    return one.model_dump(include=_PICTURE) == other.model_dump(include=_PICTURE)


def with_false(
    detections: DetectionTable, errors: DetectorErrors, dock_m: Array, camera: Camera, rng: np.random.Generator
) -> DetectionTable:
    """The same and false spots, anywhere in the picture and new in each frame.

    `dock_m` (N,) is how far the dock is from the camera in each frame, NaN in black ones, which have none.
    """
    rate = np.where(np.isnan(dock_m), 0.0, errors.rate("false", dock_m))
    false = np.repeat(np.arange(len(rate)), rng.poisson(rate))
    uv = rng.random((len(false), 2)) * [camera.width, camera.height] - 0.5
    frame = np.concatenate([detections.frame, false])
    order = np.argsort(frame, kind="stable")
    light = np.concatenate([detections.light, np.full(len(false), -1)])
    range_m = np.concatenate([detections.range_m, dock_m[false]])
    return DetectionTable(frame[order], np.concatenate([detections.uv, uv])[order], light[order], range_m[order])


def as_measured(
    errors: DetectorErrors,
    appearance: Appearance,
    detections: DetectionTable,
    rear: np.ndarray,
    noise_px: float,
    rng: np.random.Generator,
) -> Appearance:
    """Like `looks`, but lights, of which some are `rear` (M,), and false spots as measured.

    Spurious lights keep what the scenario says of them, with `noise_px` as their sigma.
    """
    n, light, stray = len(detections.light), detections.light >= 0, np.isnan(detections.range_m)
    drawn = np.stack([np.full(n, noise_px), np.zeros(n), appearance.p_light, appearance.p_rear], axis=1)
    of_rear = light & rear[detections.light]
    for kind, which in (("front", light & ~of_rear), ("rear", of_rear), ("false", ~light & ~stray)):
        drawn[which] = errors.draw(kind, detections.range_m[which], rng)
    sigma_px, over, p_light, p_rear = drawn.T
    way = rng.uniform(0.0, 2.0 * np.pi, n)
    off_px = (sigma_px * over)[:, None] * np.stack([np.cos(way), np.sin(way)], axis=1)
    off_px[stray] = appearance.off_px[stray]
    return Appearance(off_px, sigma_px[:, None, None] ** 2 * np.eye(2), p_light, p_rear)

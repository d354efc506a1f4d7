"""Errors of the default detector as measured on rendered frames, for bare detections with the same errors.

The measurements are in detector_errors.json beside this file, which `python -m bench detector-errors` writes.
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
KINDS = ("front", "rear", "false")  # detections of front lights, of other lights, and of no light
# parts of a scenario on which the image of a light depends
_IMAGE_PARTS = {"station", "water", "daylight", "lamps", "around", "matter", "lens", "sensor", "output"}


@dataclass(frozen=True, slots=True, eq=False)
class DetectionTable:
    """S detections of all frames, in the order of the frames.

    The number `frame` (S,) of the frame, true pixels `uv` (S, 2), the index `light` (S,) of the light, -1 for none, and
    the range of that light, `range_m` (S,) m. For a false detection of the detector it is the range of the dock, for a
    spurious light of the scenario NaN. `rear` (S,): whether it looks like a light of a rear layer.
    """

    frame: Indices
    uv: Array
    light: Indices
    range_m: Array
    rear: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """Values of S detections: errors of centroids `off_px` (S, 2), `cov_px2` (S, 2, 2), `p_light`, `p_rear` (S,)."""

    off_px: Array
    cov_px2: Array | None
    p_light: Array
    p_rear: Array


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """Measurements of one kind of detection in one band of range.

    `rate`: the share of lights that are detected, or the number of false detections per frame. `detections` (K, 4): of
    each its sigma px in the direction of its error, the error of the centroid over this sigma (0 for false ones),
    p_light and p_rear (NaN: unknown).
    """

    rate: float
    detections: Array


@dataclass(frozen=True, slots=True, eq=False)
class DetectorErrors:
    """Cells by kind and band of range; each band begins at one of `edges_m`, the last one has no end."""

    edges_m: Array
    cells: dict[str, tuple[Cell, ...]]

    def band(self, range_m: Array) -> Indices:
        """The band of each range, of any shape."""
        return np.asarray(np.maximum(np.searchsorted(self.edges_m, range_m, side="right") - 1, 0))

    def rate(self, kind: str, range_m: Array) -> Array:
        """The rate at each range, of any shape."""
        return np.asarray(np.array([cell.rate for cell in self.cells[kind]])[self.band(range_m)])

    def found(self, rear: np.ndarray, range_m: Array, rng: np.random.Generator) -> np.ndarray:
        """Which lights (N, M) at ranges `range_m` (N, M) are detected if lit, at random; `rear` (M,) are not front."""
        rate = np.where(rear, self.rate("rear", range_m), self.rate("front", range_m))
        return np.asarray(rng.random(range_m.shape) < rate)

    def draw(self, kind: str, range_m: Array, rng: np.random.Generator) -> Array:
        """One measured detection (N, 4) for each range (N,), drawn at random from its band."""
        band, drawn = self.band(range_m), np.full((len(range_m), 4), np.nan)
        for k, cell in enumerate(self.cells[kind]):
            here = np.flatnonzero(band == k)
            if len(here):
                drawn[here] = cell.detections[rng.integers(len(cell.detections), size=len(here))]
        return drawn


@cache
def measured_table() -> dict[str, Any]:
    """The content of the file.

    `about`, `edges_m`, and by scenario, kind and band: how many lights (or frames) there were, `of`, how many
    detections, `seen`, and a sample of these, `detections`.
    """
    content: dict[str, Any] = json.loads((files("lumidock.sim") / TABLE).read_text(encoding="utf-8"))
    return content


@cache
def detector_errors(name: str) -> DetectorErrors:
    """Measurements on frames of the shipped scenario `name`. Raises: InputError when there are none."""
    table = measured_table()
    if name not in table["scenarios"]:
        raise InputError(f"detections.detector: {name} is not measured; there are {', '.join(table['scenarios'])}")
    cells = {kind: tuple(map(_cell, table["scenarios"][name][kind])) for kind in KINDS}
    return DetectorErrors(np.array(table["edges_m"]), cells)


def _cell(content: dict[str, Any]) -> Cell:
    """One cell; a band without lights or frames gets the rate 0."""
    return Cell(content["seen"] / max(content["of"], 1), np.array(content["detections"], float).reshape(-1, 4))


def measured_like(scenario: Scenario) -> str:
    """Name of a measured scenario with the same images of lights as `scenario`. Raises: InputError without one."""
    for name in measured_table()["scenarios"]:
        if same_picture(load_scenario(name), scenario):
            return str(name)
    raise InputError(f"{scenario.name}: no detector errors were measured on such pictures")


def is_measured(scenario: Scenario) -> bool:
    """Whether detector errors were measured on pictures like those of `scenario`."""
    return any(same_picture(load_scenario(name), scenario) for name in measured_table()["scenarios"])


def same_picture(one: Scenario, other: Scenario) -> bool:
    """Whether images of lights are alike in both; path and faults may differ."""
    return one.model_dump(include=_IMAGE_PARTS) == other.model_dump(include=_IMAGE_PARTS)


def with_false(
    detections: DetectionTable, errors: DetectorErrors, dock_m: Array, camera: Camera, rng: np.random.Generator
) -> DetectionTable:
    """Add false detections, anywhere in the picture and new in each frame.

    `dock_m` (N,) is the range m of the dock in each frame; it is NaN in black frames, which get no false detections.
    """
    rate = np.where(np.isnan(dock_m), 0.0, errors.rate("false", dock_m))
    false = np.repeat(np.arange(len(rate)), rng.poisson(rate))
    uv = rng.random((len(false), 2)) * [camera.width, camera.height] - 0.5
    frame = np.concatenate([detections.frame, false])
    order = np.argsort(frame, kind="stable")
    light = np.concatenate([detections.light, np.full(len(false), -1)])
    range_m = np.concatenate([detections.range_m, dock_m[false]])
    rear = np.concatenate([detections.rear, np.zeros(len(false), bool)])
    seen = np.concatenate([detections.uv, uv])
    return DetectionTable(frame[order], seen[order], light[order], range_m[order], rear[order])


def as_measured(
    errors: DetectorErrors,
    appearance: Appearance,
    detections: DetectionTable,
    rear: np.ndarray,
    noise_px: float,
    rng: np.random.Generator,
) -> Appearance:
    """Replace the errors of lights and false detections by measured ones; which lights are `rear` (M,).

    Spurious lights of the scenario keep their `appearance`, with `noise_px` as their sigma.
    """
    n, light, injected = len(detections.light), detections.light >= 0, np.isnan(detections.range_m)
    drawn = np.stack([np.full(n, noise_px), np.zeros(n), appearance.p_light, appearance.p_rear], axis=1)
    of_rear = light & rear[detections.light]
    for kind, which in (("front", light & ~of_rear), ("rear", of_rear), ("false", ~light & ~injected)):
        drawn[which] = errors.draw(kind, detections.range_m[which], rng)
    sigma_px, over, p_light, p_rear = drawn.T
    way = rng.uniform(0.0, 2.0 * np.pi, n)
    off_px = (sigma_px * over)[:, None] * np.stack([np.cos(way), np.sin(way)], axis=1)
    off_px[injected] = appearance.off_px[injected]
    return Appearance(off_px, sigma_px[:, None, None] ** 2 * np.eye(2), p_light, p_rear)
